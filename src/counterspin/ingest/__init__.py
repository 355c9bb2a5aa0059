"""Draft a campaign's description from recorder files, and ask for missing information.

- `starter`: a commented example campaign, for users without files
- `contents`: the contents of a file: columns with units, numbers and waves
- `column_values`: properties of a column's values
- `column_roles`: the role of each column of every file
- `questions`: the questions, and conclusions from answers and signals
- `readings`: tables of readings: column roles and outputs
- `tumble`: tables of a tumble
- `arm_table`, `arm`: tables of readings on a centrifuge arm
- `triads`: the columns of a sensor with three axes, and its poses
- `poses`: records, or a table, of a sensor with three axes in many poses
- `overview`: overview of the files, and a guess of the test type
- `description`: the description from guesses and answers
"""
