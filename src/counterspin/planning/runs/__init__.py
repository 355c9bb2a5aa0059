"""What a run of a plan would tell, as a smooth function of its rate and length.

- `setup`: what is planned: instruments, attitudes, unknowns
- `run_information`: what a run tells about the unknowns
- `angle_functions`, `weights`: functions of the angle of which all columns are combinations
- `even_samples`, `information_table`: what samples tell of these: in closed form, interpolated
"""
