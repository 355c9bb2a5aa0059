"""Which runs to make for a goal, and which uncertainties a campaign will have.

- `plan`: the whole way, from ``PLAN.toml`` to a plan and back to a campaign
- `plan_sections`, `plan_file`: what may stand in ``PLAN.toml``; `read_plan`
- `forecast`, `recorded`: what a calibration will say, before there are records; of a campaign that
  has them, with their lengths, rates and noise
- `runs`: what a run of a plan would tell, as a smooth function of its rate and length
- `design`: plans, what they may be and how good they are
- `possibilities`: what may be observed, and the best numbers of it that need not be whole
- `relaxation`, `polishing`, `optimisation`: the best plan of records, and what no plan can better
- `search`, `feasibility`, `limiting`: the plan's problem, solved; whether its goal can be had, and
  what limits it
- `readings`: the same for readings: what may be read, how often to read it, and in which order
- `faults`, `sensitivities`: what may be wrong, what it would shift and leave in the residuals
- `predicted`, `requirements`: the expected uncertainties, and requirements for the centrifuge
- `result`: what planning found, its JSON
- `page`, `figures`: a plan as a person reads it, and the curves of its figures
"""
