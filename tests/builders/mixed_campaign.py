"""A campaign of an accelerometer at rest, on an arm and on a double turntable."""

import math

import numpy as np
from reading_campaigns import SITE, TRUTH, make_arm_test, simulate_readings
from reading_descriptions import format_arm_run, format_rest_run
from stations import Station

from counterspin.calibration.calibrate import calibrate
from counterspin.physics.accelerometer import Mounting
from counterspin.simulation.simulate import simulate

RATES = (3.0, 6.0, 9.9)
KINDS = ("double turntable", "at rest", "arm")
DESCRIPTION_HEAD = """schema = 1
site = { gravity = "9.80665 m/s^2", latitude = "0.8 rad" }
[centrifuge]
radius = "1.0 ± 1e-6 m"
[records]
time = { column = "time_s", unit = "s" }
angle = { column = "angle_rad", unit = "rad" }
[accelerometers.A]
input_axis = "east"
pendulous_axis = "down"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
displacement = { column = "east_m", unit = "m" }
[noise]
displacement = "1e-3 m"
"""
MODEL = """[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_III", "delta_O", "platform.tilt"]
[model.priors]
"platform.tilt" = "0 ± 0.5 arcsec"
"""
RUNS = "".join(
    f'[[runs]]\nname = "turntable {i}"\nrate = "{rate} rad/s"\nrecord = "run{i}.csv"\n'
    for i, rate in enumerate(RATES)
)
SIMULATION = """[simulation]
sampling_rate = "10 Hz"
seed = 5
revolutions = 20
[truth.A]
K_F = "2e-3 g"
K_I = "1.0005 g/g"
K_II = "15e-6 g/g^2"
K_III = "2e-6 g/g^3"
[truth.noise]
displacement = "1e-3 m"
"""


def make_tumble(count=12):
    """Return stations at rest, rotated about north from the axes of the campaign."""
    stations = []
    for angle in np.arange(count) * 2.0 * np.pi / count:
        cos, sin = math.cos(angle), math.sin(angle)
        stations.append(Station("static", Mounting.from_axes([cos, 0, -sin], [-sin, 0, -cos])))
    return stations, [""] * count, np.tile([0.0, 1.0, 0.0], (count, 1))


class MixedCampaign:
    """Provide records in a folder and simulated readings.

    The noise of the readings makes each kind about as good as the others at K_II.
    """

    def __init__(self, folder, seed=1, u_rest=2e-6, u_arm=4e-5):
        self.folder, self.u_rest, self.u_arm = folder, u_rest, u_arm
        (folder / "plan").mkdir()
        (folder / "plan" / "campaign.toml").write_text(
            DESCRIPTION_HEAD + RUNS + SIMULATION, encoding="utf-8"
        )
        simulate(folder / "plan", folder / "all")
        self.draw(seed)

    def draw(self, seed):
        """Draw the readings again."""
        rng = np.random.default_rng(seed)
        self.at_rest = simulate_readings(make_tumble(), rng, self.u_rest, truth=TRUTH)
        self.on_arm = simulate_readings(make_arm_test(), rng, self.u_arm, truth=TRUTH)

    def _rest(self):
        return "".join(
            format_rest_run(
                f"rest {i}",
                f"{30 * i} deg about north",
                f"{1.25 * value!r} ± {1.25 * self.u_rest!r} mA",
            )
            for i, value in enumerate(self.at_rest.tolist())
        )

    def _arm(self):
        stations, sides, _ = make_arm_test()
        return "".join(
            format_arm_run(
                f"{side} {i}",
                f"{station.rate!r} rad/s",
                f"{1.25 * value!r} ± {1.25 * self.u_arm!r} mA",
                side=side,
            )
            for i, (station, side, value) in enumerate(
                zip(stations, sides, self.on_arm.tolist(), strict=True)
            )
        )

    def description(self, kinds=KINDS, model=MODEL):
        """Return the description of a campaign with these types of test."""
        text = DESCRIPTION_HEAD + model
        if "double turntable" not in kinds:
            cut = DESCRIPTION_HEAD.index("displacement ="), DESCRIPTION_HEAD.index("[noise]")
            text = (
                DESCRIPTION_HEAD[: cut[0]]
                + DESCRIPTION_HEAD[cut[1] :].split("[noise]", maxsplit=1)[0]
                + model
            )
            text = text.replace(', "platform.tilt"]', "]").split("[model.priors]")[0]
        parts = {"double turntable": RUNS, "at rest": self._rest(), "arm": self._arm()}
        return text + "".join(parts[kind] for kind in kinds)

    def calibrated(self, kinds=KINDS, model=MODEL):
        """Return the result of these types of test."""
        target = self.folder / "all" / "campaign.toml"
        target.write_text(self.description(kinds, model), encoding="utf-8")
        return calibrate(self.folder / "all")


def compute_arm_indications(coefficients):
    """Return noise-free arm readings with other coefficients."""
    return np.array(
        [station.indicated(SITE, TRUTH | coefficients) for station in make_arm_test()[0]]
    )
