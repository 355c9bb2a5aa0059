"""Noise of records: models, whitening, and estimation.

- `components`: table of the noise components
- `simulation`: simulated noise of records
- `model`, `riccati`: noise models of records, whitening, and information loss by noise
- `bias_instability`: flicker and random walk of the bias
- `likelihood`: restricted likelihood of the noise of records; `even_sampling`: cosine transform of
  regularly sampled records at rest
- `search`: estimation of the noise variances
- `static_noise`: noise components of a record at rest, with intervals
- `samples`: samples of a sensor in a log with repeated values or time stamps
- `spectrum`: spectrum, spectral lines and Allan deviation
- `undetected_walk`: uncertainty due to an undetected random walk
"""
