"""From a recorder's files to a campaign's description; what cannot be known is asked.

- `starter`: a commented campaign to start from where there is no file yet
- `looking`: what is in a file: its columns with their units and numbers, and waves in them
- `guessing`: which column is what, of every file
- `questions`: what is asked, and what answers and signals show together
- `readings`: a table of readings: which column is what, and what is read in it
- `tumble`: such a table of a tumble
- `arm_table`, `arm`: of readings on the arm of a centrifuge: rates and mountings; its description
- `triads`: which columns are the axes of a sensor with three, and where it was set down
- `poses`: records, or a table, of such a sensor set down in many poses
- `description`: the description that guesses and answers make
"""
