"""Record files in, clean samples or block means out; nothing of campaigns is known here.

- `reading`: `read_record`, from a run's file to samples or block means, checked and cleaned
- `record`: the columns asked for, the stated motion, the record that comes out, and what was found
  on the way
- `format_registry`: the table of formats; `formats`: a file in any format, as columns or as a table
- `column_file`, `csv_file`, `array_files`, `tdms_file`, `table_files`: what all formats have in
  common, and each format's own
- `dialect`: what a person states on how a file is written; `layout`, `header_metadata`,
  `unit_notation`: what the lines of a table show, what the lines above the names state, and units
  and numbers as files write them
- `sampling`, `several_sensors`: the values in a log that repeat a sample, and rows of several
  sensors
- `run_file`: the files of one run as one, with the time and the angle that no file has
- `clock`, `outliers`, `reduction`: the steps of reading a chunk, in their order
- `signals`: the unit of a signal by its wave, and whether a recorder took a line off it
- `memory`: columns and frames that a program holds, in the place of a file
- `temperature_profile`: the temperature in a record over time
- `isolation`, `reader_process`, `reader_limits`: which files are read in a process of its own, that
  process, and the limits
  on its time and memory
"""
