"""Checks of records: runs while the centrifuge turns, and sensors at rest.

- `check`: one record: clock, angle, rate, residuals, and the campaign's expected uncertainty
- `mean_run`: one record on an arm or at rest, whose mean is a reading
- `watch`: the states of a campaign whose records grow
- `observer`: the existing records, read again only where they have changed; of a table its new rows
- `run_state`: what a run, a record of poses and all records together show, and whether it is enough
- `result`: what is known of a campaign while it is recorded, and of the noise of a record at rest:
  their JSON
- `page`: records judged, a campaign while it is recorded, and noise at rest, as a person reads them
- `noise`: the noise of a record at rest
"""
