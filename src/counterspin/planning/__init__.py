"""Which runs to make for a goal, and which uncertainties a campaign will have.

- `plan`: the whole way, from ``PLAN.toml`` to a plan and back to a campaign
- `plan_sections`, `plan_file`: what may stand in ``PLAN.toml``; `read_plan`
- `forecast`, `recorded`: what a calibration will say, before there are records; of a campaign that
  has them, and what further runs would add
- `run_information`: what runs would tell, as a smooth function of their rates and lengths
- `weights`, `information_table`: its parts: columns as combinations of functions of the angle, and
  what samples tell about these
- `design`: plans, what they may be and what is to be small
- `possibilities`: possible observations: what each tells and costs, and the best numbers that need
  not be whole
- `optimisation`: the best plan of records, and what no plan can better
- `search`, `limits`: the plan's problem, solved, and whether its goal can be had; what limits it
- `stations`, `reading_plan`: the same for readings: what may be read, how often, in which order
- `faults`: what faults would shift unseen, and how large each of them may become
- `result`: what a plan or a forecast says, its JSON
- `page`: a plan as a person reads it
"""
