"""``counterspin reproduce``: the paper's figures beside what they should be, and why.

Only what the paper states goes in: Tables 1 and 2, the plan of section 2.3, its printed
sigma(b2) and sigma(K_II). Everything else is computed when the command runs. The observations
are simulated from first principles, by integrating Eq. 7 with the exact kinematics, so that
they owe nothing to either of the two observation models that they judge.

- `comparison`: the whole story, with equations 20 to 34; `equations`: those before
- `plan`: what the paper states: its plan, simulated from first principles, and its figures beside
  ours
- `demo`: the paper's plan from simulation to result, by every method
- `page`: the paper's figures beside ours, and the demonstration, as a person reads them
"""
