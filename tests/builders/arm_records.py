"""Records of an accelerometer on an arm, from first principles in a few lines of NumPy."""

import math

import numpy as np

OMEGA = 7.292115e-5
GRAVITY, LATITUDE, RADIUS = 9.8066, 0.7854, 1.0
TRUTH = {"K_F": 2e-3, "K_I": 1.0006, "K_II": 1.5e-5, "K_III": 1e-6}

DESCRIPTION_HEAD = f"""schema = 1
site = {{ gravity = "{GRAVITY} m/s^2", latitude = "{LATITUDE} rad" }}
[centrifuge]
radius = "{RADIUS} ± 1e-9 m"
[records]
time = {{ column = "t", unit = "s" }}
angle = {{ column = "angle", unit = "deg", sense = "clockwise" }}
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
specific_force = {{ column = "f", unit = "g" }}
[model]
terms = ["K_F", "K_I", "K_II", "K_III"]
assume = "all"
"""


def simulate_arm_record(
    rng, side, rate, *, drift=0.0, ripple=0.0, harmonic=1, noise=0.0, encoder=0.0
):
    """Return the columns of one record: time, angle clockwise and wrapped, output in g.

    side: 1 with the input axis inward, -1 outward; the pendulous axis is up.
    rate: True rate at time zero, rad/s.
    ripple: Amplitude relative to the rate.
    """
    t = np.arange(0.0, 20.0, 0.02)
    start, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    wave = harmonic * rate * t + phase
    theta = start + rate * (t + 0.5 * drift * t**2)
    theta -= ripple / harmonic * (np.cos(wave) - math.cos(phase))
    w = rate * (1.0 + drift * t + ripple * np.sin(wave))
    inward = RADIUS * (w**2 + 2.0 * w * OMEGA * math.sin(LATITUDE)) / GRAVITY
    a = side * inward
    f = TRUTH["K_F"] + TRUTH["K_I"] * a + TRUTH["K_II"] * a**2 + TRUTH["K_III"] * a**3
    recorded_angle = -np.degrees(theta + rng.normal(0.0, encoder, t.size)) % 360.0
    return {"t": t, "angle": recorded_angle, "f": f + rng.normal(0.0, noise, t.size)}


def format_arm_run(name, side, rate):
    """Return the description of a run at its stated rate, rad/s."""
    direction = "inward" if side > 0 else "outward"
    return (
        f'[[runs]]\nname = "{name}"\nmotion = "arm"\nrate = "{rate!r} rad/s"\n'
        f'axes = {{ input = "{direction}", pendulous = "up" }}\nrecord = "{name}.csv"\n'
    )
