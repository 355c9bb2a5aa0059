"""Noise of a record: its models, whitening, and its size estimated from the records.

- `model`, `riccati`: models of a record's noise, whitening with them, and what more noise takes
  from what a record says
- `wander`: flicker and random walk of the bias
- `reduced`, `even`: a record reduced to what the likelihood needs; an even one at rest, transformed
- `search`, `restricted_likelihood`: the noise's size, estimated from the records
- `stretches`, `rest`: a record at rest, cleaned; its noise, each component with an interval
- `allan`, `spectrum`: its Allan deviation; its spectrum and the lines in it
- `unseen_noise`: what noise that the records do not show may add to the uncertainty
"""
