"""Noise of a record: its models, whitening, and its size estimated from the records.

- `components`: table of the noise components
- `simulation`: simulated noise of records
- `model`, `riccati`: models of a record's noise, whitening with them, and what more noise takes
  from what a record says
- `bias_instability`: flicker and random walk of the bias
- `likelihood`: records reduced to what the restricted likelihood of their noise needs, and it;
  `even_sampling`: of an even record at rest, by its cosine transform
- `search`: the noise's size, estimated from the records
- `static_noise`: a record at rest, cleaned; its noise, each component with an interval
- `samples`: the samples of a sensor in a record at rest, where its log repeats values or stamps
- `spectrum`: its spectrum, the lines in it, and its Allan deviation
- `undetected_walk`: uncertainty from a random walk that the records do not show
"""
