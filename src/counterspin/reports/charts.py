"""Pictures as SVG of a page, as files, and as zoomable plots.

The same picture gives the same text and the same file, byte for byte.

`render_svg` draws no title, because the page shows it as text; the SVG's ``<title>`` is for screen
readers. For the theme "page", every colour is a CSS custom property, which falls back to its colour
on paper: ``--ink`` (text and axes; falls back to ``currentColor``), ``--muted``
(levels, ticks), ``--grid``, ``--ground`` (the background: the inside of markers), ``--series-1`` to
``--series-6``, ``--warning`` (outliers), ``--negative`` and ``--positive`` (ends of the heat map,
laid over the background with an opacity of at most 0.6, so that text is legible on both). Text has
the font of the page. Drawings are 504 units wide, with text 9 units high, and scale to the
available width; at 700 pixels and more, the text is as large as that of the page.

Arrays of zoomable plots are quantised to integers, finely enough for strong zooming.
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

from counterspin.errors import CampaignError
from counterspin.output import check_writable, file_mark, marked_file_type, write_atomically
from counterspin.reports.blocks import Picture, Plot
from counterspin.reports.drawing import (
    PAPER_COLOURS,
    colour_indices,
    draw_pictures,
    drawing_parameters,
)
from counterspin.reports.typography import set_indices, typeset_block

SvgTheme = Literal["light", "page"]

#: Placeholder colours while a page's picture is drawn, recognised in the SVG text.
_PLACEHOLDERS: Final = {name: f"#01{index:02x}fe" for index, name in enumerate(PAPER_COLOURS)}
_COLOUR_NAMES: Final = {colour: name for name, colour in _PLACEHOLDERS.items()}

_PAPER_FONT: Final = "'Libertinus Serif', 'DejaVu Sans', serif"

_PAPER_HEIGHT_RATIO: Final = 0.8

#: Metadata of each file format, without a date, so that files are reproducible.
_METADATA: Final[Mapping[str, dict[str, str | None]]] = {
    ".svg": {"Creator": "counterspin", "Date": None},
    ".png": {"Software": "counterspin"},
    ".pdf": {"Creator": "counterspin", "Producer": None, "CreationDate": None},
}


#: Metadata key of a remark, by file format.
_REMARK_KEYS: Final = {".svg": "Description", ".png": "Description", ".pdf": "Subject"}


def check_figures_writable(
    paths: Iterable[Path], document_type: str, *, overwrite: bool = False
) -> None:
    """Check each existing path like `counterspin.output.check_writable`."""
    for path in paths:
        if path.exists():
            check_writable(path, partial(marked_file_type, document_type), overwrite=overwrite)


def require_figure_format(path: Path) -> str:
    """Return the suffix of a figure's file name; CampaignError if it is not supported."""
    suffix = path.suffix.lower()
    if suffix not in _METADATA:
        raise CampaignError(
            str(path),
            [f"figures cannot have this file type; the name must end in {', '.join(_METADATA)}"],
            code="wrong-file-ending",
        )
    return suffix


def save_figure(
    pictures: Sequence[Picture],
    path: Path,
    document_type: str = "a figure",
    *,
    overwrite: bool = False,
) -> None:
    """Write stacked pictures, with their titles, as SVG, PNG or PDF.

    overwrite: Whether an existing figure of this kind may be replaced; other files never are.
    """
    suffix = require_figure_format(path)
    check_writable(path, partial(marked_file_type, document_type), overwrite=overwrite)
    metadata = {**_METADATA[suffix], _REMARK_KEYS[suffix]: file_mark(document_type)}
    typeset_pictures = [cast("Picture", typeset_block(picture)) for picture in pictures]
    with drawing_parameters(PAPER_COLOURS):
        figure = draw_pictures(typeset_pictures, PAPER_COLOURS, show_titles=True)
        write_atomically(
            path,
            lambda partial_file: figure.savefig(
                partial_file, format=suffix[1:], dpi=160, metadata=metadata
            ),
            partial(marked_file_type, document_type),
            overwrite=overwrite,
        )


def render_svg(picture: Picture, *, theme: SvgTheme = "light") -> str:
    """Return a picture as SVG."""
    if theme == "light" and isinstance(picture, Plot):
        # Reduce the height for printed pages.
        picture = replace(picture, height=_PAPER_HEIGHT_RATIO * picture.height)
    with drawing_parameters(_PLACEHOLDERS):
        figure = draw_pictures([picture], _PLACEHOLDERS, show_titles=False)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    return _clean_svg(stream.getvalue(), picture, theme)


def _clean_svg(text: str, picture: Picture, theme: SvgTheme) -> str:
    """Return matplotlib's SVG without prolog, metadata, size and fonts, and with unique ids."""
    text = text[text.index("<svg") :].rstrip()
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # A style element would apply to the whole page.
    text = re.sub(r"\s*<defs>\s*<style.*?</style>\s*</defs>", "", text, flags=re.DOTALL)
    text = re.sub(r"\s*<!--.*?-->", "", text, flags=re.DOTALL)
    referenced_ids = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    id_prefix = "p" + hashlib.sha256(f"{picture.title}{theme}{text}".encode()).hexdigest()[:10]

    def clean_tag(tag: re.Match[str]) -> str:
        # Text between tags stays unchanged.
        markup = re.sub(r' transform="rotate\(-?0 [^"]*\)"| font-family: [^;"]*;?', "", tag[0])
        markup = re.sub(
            r' id="([^"]*)"', lambda match: match[0] if match[1] in referenced_ids else "", markup
        )
        markup = re.sub(r' d="([^"]*)"', lambda match: f' d="{" ".join(match[1].split())}"', markup)
        markup = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{id_prefix}-", markup)
        return re.sub(
            r"#01[0-9a-f]{2}fe", lambda match: _css_colour(_COLOUR_NAMES[match[0]], theme), markup
        )

    text = re.sub(r"<[^>]+>", clean_tag, text)
    text = re.sub(r"\n *<g>\n *</g>", "", text)
    text = re.sub(r"(<text [^>]*>)([^<]*)(?=</text>)", _set_svg_indices, text)
    svg_tag, _, body = text.partition(">")
    view_box = re.search(r'viewBox="[^"]*"', svg_tag)
    assert view_box is not None
    font_attribute = f' font-family="{_PAPER_FONT}"' if theme == "light" else ""
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'width="100%" {view_box[0]} role="img" stroke-linejoin="round"{font_attribute}>\n'
        f" <title>{escape(picture.title, quote=False)}</title>{body}"
    )


def _set_svg_indices(match: re.Match[str]) -> str:
    """Return SVG text with symbols such as K_II set as a letter and its index."""

    def format_symbol(letter: str, index: str) -> str:
        return f'{letter}<tspan dy="2" font-size="6.5">{index}</tspan><tspan dy="-2">'

    typeset_text = set_indices(match[2], format_symbol)
    return match[1] + typeset_text + "</tspan>" * typeset_text.count('<tspan dy="-2">')


def _css_colour(name: str, theme: SvgTheme) -> str:
    paper_colour = PAPER_COLOURS[name]
    if theme == "light":
        return paper_colour
    return f"var(--{name}, {'currentColor' if name == 'ink' else paper_colour})"


#: Smallest number of quantisation steps of an axis.
_MIN_QUANTISATION_STEPS: Final = 2e4


def is_zoomable(plot: Plot) -> bool:
    """Return whether a plot is zoomable: requested, and with a numeric axis."""
    x_values = {x for series in plot.series for x in series.x}
    return plot.zoom and not plot.x_names and len(x_values) > 1


def plot_json(plot: Plot) -> str:
    """Return a plot as JSON for a page's script element."""
    series_documents = []
    for series, colour in zip(plot.series, _series_colours(plot), strict=True):
        low, high = (
            None if limits is None else _quantise(limits, plot.log_y)
            for limits in (series.low, series.high)
        )
        series_documents.append(
            {
                "label": series.label,
                "kind": series.kind,
                "is_highlighted": series.is_highlighted,
                "colour": colour,
                "x": _quantise(series.x, plot.log_x),
                "y": None if series.kind == "band" else _quantise(series.y, plot.log_y),
                "low": low,
                "high": high,
            }
        )
    document = {
        "x_label": plot.x_label,
        "y_label": plot.y_label,
        "log_x": plot.log_x,
        "log_y": plot.log_y,
        "levels": plot.levels,
        "series": series_documents,
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    # Escape </script> and <!--, which JSON allows.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _series_colours(plot: Plot) -> Iterator[str]:
    """Yield the CSS property of each series' colour, the same as in the static picture."""
    for series, index in zip(plot.series, colour_indices(plot.series), strict=True):
        if index is None:
            yield "--warning" if series.is_highlighted else "--muted"
        else:
            yield f"--series-{index + 1}"


def _quantise(values: Sequence[float | None], is_logarithmic: bool) -> dict[str, Any]:
    """Return an array quantised to integers, which takes a third of the characters."""
    finite_values = [value for value in values if value is not None and math.isfinite(value)]
    if is_logarithmic:
        return {"step": 1, "values": [_round_finite(value, _round_significant) for value in values]}
    value_range = max(finite_values, default=0.0) - min(finite_values, default=0.0)
    value_range = value_range or max(map(abs, finite_values), default=0.0) or 1.0
    step = 10.0 ** math.floor(math.log10(value_range / _MIN_QUANTISATION_STEPS))
    return {
        "step": step,
        "values": [_round_finite(value, lambda number: round(number / step)) for value in values],
    }


def _round_significant(value: float) -> float:
    return float(f"{value:.4g}")


def _round_finite(value: float | None, round_value: Callable[[float], float]) -> float | None:
    return None if value is None or not math.isfinite(value) else round_value(value)
