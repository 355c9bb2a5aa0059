"""Triads: three accelerometers of one sensor, and poses whose attitudes nobody knows.

- `declared`: [triad], and runs with ``attitude = "unknown"``
- `grouped`: poses by whether their noise was stated, as simulation and fit take them
"""
