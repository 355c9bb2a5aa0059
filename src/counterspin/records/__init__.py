"""Record files in, clean samples or block means out; nothing of campaigns is known here.

- `reading`: `read_record`, from a run's file to samples or block means, checked and cleaned
- `record`: the columns asked for, the stated motion, and the record that comes out
- `formats`, `column_file`, `csv_file`, `parquet_file`, `array_files`, `excel_file`, `tdms_file`:
  the files, by format
- `dialect`, `heads`: how files of text are written, and what the lines above their names and
  their cells state
- `run_file`: the files of one run as one, with the time and the angle that no file has
- `pieces`, `clock`, `spikes`, `reduction`, `amplitude`: the steps of reading, in the order in
  which a record passes them
- `removed`: whether a recorder took a mean, a line or a parabola off
- `memory`: columns that a program holds, in the place of a file
- `mean`: the mean of a record over whole revolutions, and how uncertain its noise leaves it
- `course`: a temperature in a record, as a few values at even times
- `poses`: where a sensor with three axes lay still, in one long record
- `report`: what was found on the way
- `tables`: a file as a table, for those who add columns to it
- `isolation`: the process of its own in which native code reads
"""
