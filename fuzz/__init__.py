"""Fuzz every reader of counterspin with mutated files, and kill commands at every write.

    python -m fuzz --documents 100000 --records 2000     # `make fuzz`

- `mutations`: mutations of bytes, text, trees (TOML, JSON, XML) and tables
- `formats`: for every input format: seed files, mutations and reader
- `format`: definition of a format; `requests`, `connections`: requests to the application;
  `application_client`: send requests, check responses and files
- `native`: record files read by native code
- `hunt`: runs cases, judges the outcomes, stores the findings
- `tracing`: stops programs at system calls
- `kills`: kills processes at each system call on an output
"""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

# The seed files come from the builders of the tests.
_BUILDERS = str(ROOT / "tests" / "builders")
if _BUILDERS not in sys.path:
    sys.path.append(_BUILDERS)
