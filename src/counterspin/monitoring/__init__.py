"""Checks of records: runs while the centrifuge turns, and sensors at rest.

- `check`: one record: clock, angle, rate, residuals, and the campaign's expected uncertainty
- `watch`: the states of a campaign whose records grow
- `growing_table`: a text table that grows; only its new rows are read
- `observer`: the existing records, read again only if they have changed
- `run_state`: the state of a run, in numbers and in sentences
- `poses`: the same of a record of poses, and which directions are missing
- `goals`: the fit of the existing records; goals, and whether they are met
- `result`: what both say, and its JSON
- `page`: both as a person reads them
- `noise`, `result_noise`, `noise_page`: the noise of a record at rest, its JSON, its page
"""
