"""Record files in, clean samples or block means out; nothing of campaigns is known here.

- `reading`: `read_record`, from a run's file to samples or block means, checked and cleaned
- `column_file`, `csv_file`, `formats`: the files themselves, whatever their format
- `clock`, `clock_faults`, `spikes`, `reduction`, `amplitude`: the steps of reading, in the order
  in which a record passes them
- `report`: what was found on the way
"""
