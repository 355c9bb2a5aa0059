"""Records judged: runs while the centrifuge turns, and sensors at rest.

- `check`: one record: clock, angle, rate, residuals, and what the campaign's u will be with it
- `watch`: the states of a campaign whose records grow
- `following`: a text table that grows, its new rows alone read
- `observing`: the records that are there, read again only where they have changed
- `judging`: what a run shows, in numbers and in sentences
- `poses`: the same of a record of poses, and which directions are missing
- `reaching`: the fit of what is there; goals, and whether they are met
- `result`: what both say, and its JSON
- `page`: both as a person reads them
- `noise`, `result_noise`, `noise_page`: the noise of a record at rest, its JSON, its page
"""
