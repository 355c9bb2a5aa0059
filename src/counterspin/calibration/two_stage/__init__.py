"""The two-stage method. A calibration calls it by name, through `extensions`.

- `method`: from observed runs to the paper's result of each accelerometer
- `findings`: its findings
- `comparison`: comparison of its K_II with the joint K_II
"""
