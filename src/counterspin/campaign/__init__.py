"""Campaigns as files: quantities with units, the description, what it asks for.

A campaign is a folder: ``campaign.toml`` beside its record files.

- `quantity`: text such as ``"2.5 ± 1e-5 m"`` to numbers in SI and g-units
- `attitude`: directions and platform attitudes
- `settings`: what may stand in ``campaign.toml``, section by section
- `checking`: mistakes, collected and told in the user's words
- `terms`: which error terms a campaign asks for, and their priors
- `truth`: what a simulated campaign is made of; calibration never looks at it
- `specification`: limits that coefficients shall lie between, and the rule to judge it by
- `resolved`: the campaign as the calculation sees it, in SI
- `toml_file`: files in TOML; `description`: `read_campaign`, from the file to the resolved campaign
- `checksums`: of a campaign's files
- `starter`: a commented campaign to start from
- `simulation`: records of a campaign whose coefficients are known
"""
