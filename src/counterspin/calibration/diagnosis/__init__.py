"""The causes of a misfit. A calibration calls it by name, through `extensions`.

- `search`: the likely causes, each tried on the records
- `ranking`: the best explanation and its rivals; `explanations`: the text about each
- `noise`: noise that is stated wrongly, or differs between runs
- `untested_inputs`: mountings and values that the data contradict, or cannot check
"""
