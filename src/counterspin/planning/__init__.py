"""Plans of the runs for a goal, and forecasts of the uncertainties of a campaign.

- `plan`: the whole way, from ``PLAN.toml`` to a plan and back to a campaign
- `plan_sections`, `plan_file`: the sections of ``PLAN.toml`` and their checks; `read_plan`
- `forecast`, `recorded`: predicted uncertainties before and with records, and the gain of further
  runs
- `run_information`: information of runs, as a smooth function of their rates and lengths
- `weights`, `information_table`: columns as combinations of functions of the angle, and the
  information of samples about these functions
- `design`: plans, their limits and their criterion
- `candidate_set`: information and cost of possible observations, and their best numbers, which
  need not be whole
- `optimisation`: the best plan of records, and a bound on any plan
- `search`, `limits`: solution of the plan's problem, feasibility of its goal; active limits
- `stations`, `reading_plan`: the same for readings: possible readings, their numbers and order
- `faults`: shifts by undetected faults, and the largest tolerable size of each fault
- `sensitivities`: the change of estimates by effects that a model lacks
- `result`: the result of a plan or a forecast, its JSON
- `page`: the printed report of a plan
"""
