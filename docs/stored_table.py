"""Tables of simulation results: stored as JSON, shown on a page, checked by tests.

- `StoredTable`: a table, the file that stores its rows and the page that shows it
- `run_study`: main program of the module that computes a table
- `describe_site`, `describe_runs`, `describe_channel`: common TOML sections of campaigns
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

DOCS: Final = Path(__file__).parent

#: Observable -> unit of the recorded signal.
UNITS: Final = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}

#: Rates of the default three runs, rev/s.
DEFAULT_RATES: Final = ("0.25", "0.5", "1")

Row = TypeVar("Row")


@dataclass(frozen=True)
class StoredTable(Generic[Row]):
    """A table of a page of the documentation.

    Attributes
    ----------
    name
        Stem of the JSON file, and name of the markers in the page.
    page
        Path of the page.
    row
        Dataclass of a row.
    render
        Rows -> Markdown.
    """

    name: str
    page: Path
    row: Callable[..., Row]
    render: Callable[[Sequence[Row]], str]

    @property
    def file(self) -> Path:
        """Path of the JSON file with the rows."""
        return DOCS / f"{self.name}.json"

    def insert(self, rows: Sequence[Row], page: str) -> str:
        """Return the text of the page with the table between its markers."""
        before, start_marker, remainder = page.partition(f"<!-- {self.name} -->\n")
        _, end_marker, after = remainder.partition(f"<!-- /{self.name} -->")
        if not start_marker or not end_marker:
            raise ValueError(f"the page has no markers for the table {self.name}")
        return f"{before}{start_marker}{self.render(rows)}{end_marker}{after}"

    def load(self) -> list[Row]:
        """Return the stored rows."""
        return [self.row(**row) for row in json.loads(self.file.read_text(encoding="utf-8"))]

    def store(self, rows: Sequence[Any]) -> None:
        """Write the rows to the JSON file and the page."""
        text = json.dumps([asdict(row) for row in rows], indent=1)
        self.file.write_text(f"{text}\n", encoding="utf-8")
        page = self.page.read_text(encoding="utf-8")
        self.page.write_text(self.insert(rows, page), encoding="utf-8")


def run_study(summary: str, compute: Callable[[], None]) -> None:
    """Parse the command line, whose only option is --help, and then compute a table."""
    argparse.ArgumentParser(description=summary).parse_args()
    compute()


def format_table(alignments: Mapping[str, str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; alignments: column name -> "---" or "---:"."""
    lines = [f"| {' | '.join(line)} |" for line in [list(alignments), *rows]]
    lines.insert(1, f"|{'|'.join(alignments.values())}|")
    return "\n".join(lines) + "\n"


def describe_site(
    gravity: str = "9.8066 m/s^2", latitude: str = "45.75 deg", radius: str = "2.5 m"
) -> str:
    """Return the TOML of site, centrifuge, and time and angle columns."""
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


def describe_channel(observable: str, axis: str) -> str:
    """Return the TOML of axes and column of an accelerometer with input axis east or north."""
    return f"""input_axis = "{axis}"
pendulous_axis = "down"
{observable} = {{ column = "{axis}", unit = "{UNITS[observable]}" }}
"""


def describe_runs(rates: Sequence[str] = DEFAULT_RATES) -> str:
    """Return the TOML of [[runs]] run1, run2 and so on; rates in rev/s."""
    return "".join(
        f"""
[[runs]]
name = "run{number}"
rate = "{rate} rev/s"
record = "run{number}.csv"
"""
        for number, rate in enumerate(rates, 1)
    )
