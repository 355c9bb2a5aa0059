"""``counterspin reproduce``: figures of the paper and correct figures, with reasons.

The inputs are only data that the paper states: Tables 1 and 2, the plan of section 2.3, and the
printed sigma(b2) and sigma(K_II). Everything else is computed when the command runs. The
observations are simulated by integrating Eq. 7 with the exact kinematics, so that they are
independent of the two observation models that they test.

- `comparison`: all figures, with equations 20 to 34; `equations`: equations 5 to 19
- `plan`: the paper's plan, simulated from first principles, and the rows of the comparison
- `demo`: the paper's plan from simulation to result, by every method
- `page`: the reports of the reproduction and of the demonstration
"""
