"""``counterspin reproduce``: the paper's figures and the correct ones, with the reasons.

Only what the paper states goes in: Tables 1 and 2, the plan of section 2.3, its printed
sigma(b2) and sigma(K_II). Everything else is computed when the command runs. The observations
are simulated from first principles, by integrating Eq. 7 with the exact kinematics, so that
they are independent of the two observation models that they test.

- `comparison`: all figures, with equations 20 to 34; `equations`: equations 5 to 19
- `plan`: the paper's plan, simulated from first principles, and its figures compared with ours
- `demo`: the paper's plan from simulation to result, by every method
- `page`: the printed report of the paper's figures, ours, and the demonstration
"""
