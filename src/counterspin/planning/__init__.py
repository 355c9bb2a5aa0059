"""Which runs to make for a goal, and what a campaign will tell before it is recorded.

- `plan`: the whole way, from ``PLAN.toml`` to a plan and back to a campaign
- `settings`, `description`: what may stand in ``PLAN.toml``; `read_plan`
- `forecast`: what a calibration will say, before there are records
- `setup`, `angle_functions`, `run_information`: what a run of a plan would tell, as a smooth
  function of its rate and length
- `design`: plans, what they may be and how good they are
- `relaxation`, `polishing`, `optimal`: the best plan, and what no plan can better
- `search`, `determined`: the plan's problem, solved; whether its goal can be had
- `parts`, `curves`: its result's parts; its figures' curves
- `result`: what planning found, its JSON; `toml_text`: the campaign it writes
- `page`, `figures`: a plan as a person reads it
"""
