"""TOML files, read with errors that say where.

- `load_document`: a file's tables
- `description_file`: the description's file of a campaign
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

from counterspin.errors import CampaignError

DESCRIPTION_NAME: Final = "campaign.toml"  #: the description's file in a campaign folder


def description_file(where: Path | str) -> Path:
    """Return the description's file, of a campaign's folder or of the file itself."""
    given = Path(where)
    return given / DESCRIPTION_NAME if given.is_dir() else given


def load_document(
    file: Path, advice: str = "`counterspin init DIR` makes a campaign to start from"
) -> dict[str, Any]:
    """Return a TOML document; `advice` is for a file that is not there.

    Raises
    ------
    CampaignError
        If the file is missing, cannot be read, is not UTF-8 or not TOML.
    """
    try:
        # Editors on Windows put a byte-order mark before the text; TOML knows none.
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        problem = f"there is no such file; {advice}"
    except UnicodeDecodeError:
        problem = "is not UTF-8 text; save it as UTF-8 (the sign ± needs it; +/- serves as well)"
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
    except tomllib.TOMLDecodeError as error:
        place = re.fullmatch(r"(.*) \(at (.*)\)", str(error), flags=re.DOTALL)
        what, where = (place[1], place[2]) if place else (str(error), "TOML")
        what = what[:1].lower() + what[1:]
        problem = f"{where}: {what}; text such as a quantity is written in quotation marks"
    raise CampaignError(str(file), [problem])
