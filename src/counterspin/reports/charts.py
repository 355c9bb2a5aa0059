"""Pictures as SVG of a page, as files, and as zoomable plots.

The same picture gives the same text and the same file, byte for byte.

`svg` draws no title, because the page sets it in words; the title is the SVG's ``<title>``, which
screen readers read. For the theme "page" every colour is a CSS custom property, which falls back to
its colour on paper: ``--ink`` (words and axes; falls back to ``currentColor``), ``--muted``
(levels, ticks), ``--grid``, ``--ground`` (the background: the inside of markers), ``--series-1`` to
``--series-6``, ``--warning`` (outliers), ``--negative`` and ``--positive`` (ends of the heat map,
laid over the ground with an opacity of at most 0.6, so that words in ink are legible on both).
Words take the font of the page. All is drawn 504 units wide with words 9 units high, and scales to
the available width; at 700 pixels and more the words are as large as the page's.

The arrays travel as whole numbers, rounded to the resolution of a screen even after much zooming.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any, Final, Literal, cast

from counterspin.errors import CounterspinError
from counterspin.output import check_writable, file_mark, marked_file_type, write_atomically
from counterspin.reports.blocks import Picture, Plot
from counterspin.reports.drawing import PAPER_COLOURS, colour_indices, draw_pictures, settings
from counterspin.reports.typography import set_indices, typeset_block

Theme = Literal["light", "page"]

#: Placeholder colours while a page's picture is drawn, recognised in the SVG text.
_PLACEHOLDERS: Final = {name: f"#01{index:02x}fe" for index, name in enumerate(PAPER_COLOURS)}
_NAMES: Final = {colour: name for name, colour in _PLACEHOLDERS.items()}

_FONT_OF_PAPER: Final = "'Libertinus Serif', 'DejaVu Sans', serif"

_HEIGHT_ON_PAPER: Final = 0.8

#: Metadata of each file format, without a date, so that files are reproducible.
_METADATA: Final[Mapping[str, dict[str, str | None]]] = {
    ".svg": {"Creator": "counterspin", "Date": None},
    ".png": {"Software": "counterspin"},
    ".pdf": {"Creator": "counterspin", "Producer": None, "CreationDate": None},
}


#: Metadata key of a remark, by file format.
_REMARKS: Final = {".svg": "Description", ".png": "Description", ".pdf": "Subject"}


def reserve_figures(paths: Iterable[Path], kind: str, *, overwrite: bool = False) -> None:
    """Refuse figures that would overwrite a file, as `counterspin.output.check_writable` does."""
    for path in paths:
        if path.exists():
            check_writable(path, partial(marked_file_type, kind), overwrite=overwrite)


def check_format(path: Path) -> str:
    """Return the format of a figure's file name; CounterspinError if it is not supported."""
    kind = path.suffix.lower()
    if kind not in _METADATA:
        raise CounterspinError(
            (
                f"{path}: unsupported file type for a figure; the name must end in "
                f"{', '.join(_METADATA)}"
            ),
            code="wrong-file-ending",
        )
    return kind


def save_figure(
    pictures: Sequence[Picture], path: Path, kind: str = "a figure", *, overwrite: bool = False
) -> None:
    """Write stacked pictures, with their titles, as SVG, PNG or PDF.

    overwrite: Whether an existing figure of this kind may be replaced; other files never are.
    """
    suffix = check_format(path)
    check_writable(path, partial(marked_file_type, kind), overwrite=overwrite)
    metadata = {**_METADATA[suffix], _REMARKS[suffix]: file_mark(kind)}
    printed = [cast("Picture", typeset_block(picture)) for picture in pictures]
    with settings(PAPER_COLOURS):
        figure = draw_pictures(printed, PAPER_COLOURS, titled=True)
        write_atomically(
            path,
            lambda part: figure.savefig(part, format=suffix[1:], dpi=160, metadata=metadata),
            partial(marked_file_type, kind),
            overwrite=overwrite,
        )


def svg(picture: Picture, *, theme: Theme = "light") -> str:
    """Draw a picture."""
    if theme == "light" and isinstance(picture, Plot):
        # Lower figures fit better on a page of paper.
        picture = replace(picture, height=_HEIGHT_ON_PAPER * picture.height)
    with settings(_PLACEHOLDERS):
        figure = draw_pictures([picture], _PLACEHOLDERS, titled=False)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    return _clean_svg(stream.getvalue(), picture, theme)


def _clean_svg(text: str, picture: Picture, theme: Theme) -> str:
    """Return matplotlib's SVG without prolog, metadata, size, foreign font and common ids."""
    text = text[text.index("<svg") :].rstrip()
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # A style element would apply to the whole page.
    text = re.sub(r"\s*<defs>\s*<style.*?</style>\s*</defs>", "", text, flags=re.DOTALL)
    text = re.sub(r"\s*<!--.*?-->", "", text, flags=re.DOTALL)
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    salt = "p" + hashlib.sha256(f"{picture.title}{theme}{text}".encode()).hexdigest()[:10]

    def cleaned_tag(tag: re.Match[str]) -> str:
        # Text between tags stays unchanged.
        words = re.sub(r' transform="rotate\(-?0 [^"]*\)"| font-family: [^;"]*;?', "", tag[0])
        words = re.sub(r' id="([^"]*)"', lambda at: at[0] if at[1] in used else "", words)
        words = re.sub(r' d="([^"]*)"', lambda at: f' d="{" ".join(at[1].split())}"', words)
        words = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{salt}-", words)
        return re.sub(r"#01[0-9a-f]{2}fe", lambda at: _colour(_NAMES[at[0]], theme), words)

    text = re.sub(r"<[^>]+>", cleaned_tag, text)
    text = re.sub(r"\n *<g>\n *</g>", "", text)
    text = re.sub(r"(<text [^>]*>)([^<]*)(?=</text>)", _set_indices, text)
    head, _, body = text.partition(">")
    box = re.search(r'viewBox="[^"]*"', head)
    assert box is not None
    font = f' font-family="{_FONT_OF_PAPER}"' if theme == "light" else ""
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'width="100%" {box[0]} role="img" stroke-linejoin="round"{font}>\n'
        f" <title>{escape(picture.title, quote=False)}</title>{body}"
    )


def _set_indices(found: re.Match[str]) -> str:
    """Return text of a picture with symbols such as K_II as a letter and its index."""

    def lowered(letter: str, index: str) -> str:
        return f'{letter}<tspan dy="2" font-size="6.5">{index}</tspan><tspan dy="-2">'

    words = set_indices(found[2], lowered)
    return found[1] + words + "</tspan>" * words.count('<tspan dy="-2">')


def _colour(name: str, theme: Theme) -> str:
    paper = PAPER_COLOURS[name]
    if theme == "light":
        return paper
    return f"var(--{name}, {'currentColor' if name == 'ink' else paper})"


#: Smallest number of quantisation steps of an axis.
_MIN_STEPS: Final = 2e4


def can_zoom(plot: Plot) -> bool:
    """Return whether a plot is zoomable: requested, and with a numeric axis."""
    return (
        plot.zoom and not plot.x_names and len({x for series in plot.series for x in series.x}) > 1
    )


def plot_data(plot: Plot) -> str:
    """Return a plot as JSON for a page's script element."""
    rows = []
    for series, colour in zip(plot.series, _colours(plot), strict=True):
        low, high = (
            None if ends is None else _quantise(ends, plot.log_y)
            for ends in (series.low, series.high)
        )
        rows.append(
            {
                "label": series.label,
                "kind": series.kind,
                "stands_out": series.stands_out,
                "colour": colour,
                "x": _quantise(series.x, plot.log_x),
                "y": None if series.kind == "band" else _quantise(series.y, plot.log_y),
                "low": low,
                "high": high,
            }
        )
    data = {
        "x_label": plot.x_label,
        "y_label": plot.y_label,
        "log_x": plot.log_x,
        "log_y": plot.log_y,
        "levels": plot.levels,
        "series": rows,
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # Escape </script> and <!--, which JSON allows.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _colours(plot: Plot) -> Iterator[str]:
    """Yield the CSS property of each series' colour, the same as in the static picture."""
    for series, place in zip(plot.series, colour_indices(plot.series), strict=True):
        if place is None:
            yield "--warning" if series.stands_out else "--muted"
        else:
            yield f"--series-{place + 1}"


def _quantise(values: Sequence[float | None], log: bool) -> dict[str, Any]:
    """Return an array quantised to integers, which takes a third of the characters."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    if log:
        return {
            "step": 1,
            "values": [_kept(value, lambda v: float(f"{v:.4g}")) for value in values],
        }
    spread = max(finite, default=0.0) - min(finite, default=0.0)
    spread = spread or max(map(abs, finite), default=0.0) or 1.0
    step = 10.0 ** math.floor(math.log10(spread / _MIN_STEPS))
    return {"step": step, "values": [_kept(value, lambda v: round(v / step)) for value in values]}


def _kept(value: float | None, rounded: Callable[[float], float]) -> float | None:
    return None if value is None or not math.isfinite(value) else rounded(value)
