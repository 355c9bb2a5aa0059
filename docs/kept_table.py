"""Tables of the documentation that trials make: kept as JSON, shown on a page, checked by tests.

- `KeptTable`: the rows of one, the file that keeps them and the page that shows them
- `frame`, `runs`, `channel`: what the campaigns of the trials have in common, as TOML
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

DOCS: Final = Path(__file__).parent

#: Unit of what is recorded.
UNITS: Final = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}

#: Rates of the usual three runs, rev/s.
RATES: Final = ("0.25", "0.5", "1")

Row = TypeVar("Row")


@dataclass(frozen=True)
class KeptTable(Generic[Row]):
    """A table of a page of the documentation.

    Attributes
    ----------
    name
        Of the file that keeps it, NAME.json, and of its place in the page.
    page
        The page's file.
    row
        The dataclass of its rows.
    render
        Rows -> Markdown.
    """

    name: str
    page: Path
    row: Callable[..., Row]
    render: Callable[[Sequence[Row]], str]

    @property
    def file(self) -> Path:
        """The file that keeps the rows."""
        return DOCS / f"{self.name}.json"

    def insert(self, rows: Sequence[Row], page: str) -> str:
        """Return the page's text with the table in its place."""
        before, begun, rest = page.partition(f"<!-- {self.name} -->\n")
        _, ended, after = rest.partition(f"<!-- /{self.name} -->")
        if not begun or not ended:
            raise ValueError(f"the page has no place for the table {self.name}")
        return f"{before}{begun}{self.render(rows)}{ended}{after}"

    def load(self) -> list[Row]:
        """Return the rows that are kept."""
        return [self.row(**row) for row in json.loads(self.file.read_text(encoding="utf-8"))]

    def keep(self, rows: Sequence[Any]) -> None:
        """Write rows into file and page."""
        text = json.dumps([asdict(row) for row in rows], indent=1)
        self.file.write_text(f"{text}\n", encoding="utf-8")
        page = self.page.read_text(encoding="utf-8")
        self.page.write_text(self.insert(rows, page), encoding="utf-8")


def table_of(head: Mapping[str, str], rows: Sequence[Sequence[str]]) -> str:
    """Return Markdown: the columns' names with their alignment ("---" or "---:"), and rows."""
    lines = [f"| {' | '.join(line)} |" for line in [list(head), *rows]]
    lines.insert(1, f"|{'|'.join(head.values())}|")
    return "\n".join(lines) + "\n"


def frame(gravity: str = "9.8066 m/s^2", latitude: str = "45.75 deg", radius: str = "2.5 m") -> str:
    """Return where a campaign takes place, on what, and the columns of time and angle."""
    return f"""
schema = 1

[site]
gravity = "{gravity}"
latitude = "{latitude}"

[centrifuge]
radius = "{radius}"

[records]
time = {{ column = "time_s", unit = "s" }}
angle = {{ column = "angle_rad", unit = "rad" }}
"""


def channel(observable: str, axis: str) -> str:
    """Return an accelerometer's axes, and its column, for an input axis to the east or north."""
    return f"""input_axis = "{axis}"
pendulous_axis = "down"
{observable} = {{ column = "{axis}", unit = "{UNITS[observable]}" }}
"""


def runs(rates: Sequence[str] = RATES) -> str:
    """Return [[runs]] run1, run2 and so on."""
    return "".join(
        f"""
[[runs]]
name = "run{number}"
rate = "{rate} rev/s"
record = "run{number}.csv"
"""
        for number, rate in enumerate(rates, 1)
    )
