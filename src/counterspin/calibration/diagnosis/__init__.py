"""The causes of a misfit. A calibration calls it by name, through `extensions`.

- `search`: the likely causes, each tried on the records; `words`: their explanations
- `noise`: noise that is stated wrongly, or differs between runs
- `statements`: mountings and values that the data contradict, or cannot check
"""
