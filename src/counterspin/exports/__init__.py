"""From a recorder's files to a campaign's description; what cannot be known is asked.

- `looking`: what is in a file: its columns with their units and numbers
- `waves`: the wave that a revolution makes in a column
- `guessing`: which column is what, of every file
- `questions`: what is asked, and what an answer means
- `tumble`: a table of readings of a tumble
- `poses`: a record of a sensor with three axes, set down in many poses
- `description`: the description that guesses and answers make
"""
