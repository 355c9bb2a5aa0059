"""Checks of records: runs while the centrifuge turns, and sensors at rest.

- `check`: one record: clock, angle, rate, residuals, and the campaign's expected uncertainty
- `mean_run`: one record on an arm or at rest, whose mean is a reading
- `watch`: the states of a campaign whose records grow
- `observer`: the existing records, read again only where they have changed; for a table, only its
  new rows
- `run_state`: the state of a run, of a record of poses and of all records, and their verdicts
- `result`: the state of a campaign while it is recorded, and the noise of a record at rest: their
  JSON
- `page`: printed reports of checked records, of a campaign while it is recorded, and of noise
- `noise`: the noise of a record at rest
- `row_times`: the times of the rows of a record at rest
"""
