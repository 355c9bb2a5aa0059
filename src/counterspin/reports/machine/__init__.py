"""Drawings of the machine: which way its axes point, where an angle begins, which way it counts.

Each is drawn from the vectors of the frame (east, north, up), so that what is drawn is what is
computed; every arrow states the direction that it shows (`Arrow`), for tests to compare.

- `canvas`: lines, arrows and words as SVG; a view of what has three dimensions
- `drawings`: the drawings, by name
"""
