"""What every test runs under."""

import os

# The matrices are small: a second thread of linear algebra costs more than it brings, and eight
# times as much while tests run side by side. It counts only before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
