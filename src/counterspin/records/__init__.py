"""Reading of record files into clean samples or block means, independent of campaigns.

- `reading`: `read_record` reads a run's file, checks and cleans it, and computes block means
- `record`: the requested columns, the stated motion, the record, and the report on its reading
- `format_registry`: table of the file formats; `formats`: files of any format as columns or tables
- `column_file`: common interface of all formats; `csv_file`, `array_files`, `tdms_file`,
  `table_files`: readers of the formats
- `dialect`: stated properties of a text file; `layout`: detected layout of a table;
  `header_footer`: lines above the names and below the rows; `unit_notation`: units and numbers in
  the notations of files
- `sampling`: repeated values and time stamps; `several_sensors`: rows of several sensors in a file
- `run_file`: the files of a run as one file, with derived time and angle
- `clock`, `outliers`, `reduction`: the steps of processing a chunk, in this order
- `signals`: the unit of a signal by its amplitude; detection of removed trends
- `memory`: columns and data frames in memory in place of a file
- `temperature_profile`: temperature in a record over time
- `isolation`: choice of the files that a separate process reads; `reader_process`: that process;
  `reader_limits`: its time and memory limits
"""
