"""The two-stage method. A calibration calls it by name, through `extensions`.

- `method`: from observed runs to the paper's result of each accelerometer
- `findings`: its findings
- `comparison`: its K_II beside the joint one
"""
