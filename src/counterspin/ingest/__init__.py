"""Draft a campaign's description from recorder files, and ask what the files do not show.

- `starter`: a commented example campaign, for users without files
- `contents`: the contents of a file: columns with units, numbers and waves
- `column_roles`: the role of each column of every file
- `questions`: the questions, and what answers and signals show together
- `readings`: a table of readings: the role of each column, and its readings
- `tumble`: tables of a tumble
- `arm`: tables of readings on a centrifuge arm
- `triads`: the columns of a sensor with three axes, and its poses
- `poses`: records, or a table, of a sensor with three axes in many poses
- `overview`: what was seen in the files, and the kind of test that they look like
- `description`: the description made from guesses and answers
"""
