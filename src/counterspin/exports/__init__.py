"""From a recorder's files to a campaign's description; what cannot be known is asked.

- `looking`: what is in a file: its columns with their units and numbers
- `waves`: the wave that a revolution makes in a column
- `guessing`: which column is what, of every file
- `questions`: what is asked, and what an answer means
- `relations`: what signals show together: the sense, a unit by the radius, an axis by the other
- `readings`: a table of readings: which column is what, and what is read in it
- `tumble`: such a table of a tumble
- `arm_table`, `arm`: of readings on the arm of a centrifuge: rates and mountings; its description
- `axes`: which columns may be the three axes of a sensor, by names and order
- `triads`: which columns are the axes of a sensor with three, and where it was set down
- `poses`: records, or a table, of such a sensor set down in many poses
- `description`: the description that guesses and answers make
"""
