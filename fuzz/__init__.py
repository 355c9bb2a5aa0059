"""Mutated files for every reader of counterspin, and kills at every step of writing.

    python -m fuzz --documents 100000 --records 2000     # `make fuzz`

- `mutations`: of bytes, of text, of trees (TOML, JSON, XML) and of tables
- `formats`: every format that is read: files to begin with, how they are mutated, who reads them
- `format`: what a format is; `requests`, `connections`: what is asked of the application;
  `asking`: how, and what must hold of its answers and files
- `native`: record files of the formats that native code reads
- `hunt`: tries cases, judges what comes of them, keeps what is found
- `tracing`: programs stopped at system calls
- `kills`: processes killed at each system call that has to do with an output
"""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

# The files to begin with are those that the tests begin with.
_BUILDERS = str(ROOT / "tests" / "builders")
if _BUILDERS not in sys.path:
    sys.path.append(_BUILDERS)
