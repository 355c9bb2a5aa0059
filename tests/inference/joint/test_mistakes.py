"""What a mistake does to a record is what it does to an exact one."""

from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import three_rates, unknowns

from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import scores
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.relaxed import relax
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise

MODEL = Unknowns(unknowns(["K_F", "K_I", "K_II"]))
SIZE = 30e-6  # g


def held(records):
    """Return steps in the records, held against their fit, and its noise."""
    fit = relax(estimate(records, MODEL, {"Qx": Noise(0.01, 0.0)}, reject=False).fit)
    return scores(fit, tuple(mistakes.jumps(fit, 9)), noise_given=True)


@pytest.fixture(scope="module")
def sound():
    return three_rates({"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5})


def test_a_step_of_the_bias_is_found_where_and_as_large_as_it_is(sound):
    """From a step of b at a time s on, a displacement grows by b g (t - s)^2/2."""
    *others, last = sound
    low, high = float(last.time[0]), float(last.time[-1])
    for part in (0.1, 0.4, 0.8):  # of the ten parts between nine steps
        at = low + part * (high - low)
        later = np.maximum(last.time - at, 0.0)
        fallen = SIZE * last.trajectory.site.gravity * later**2 / 2.0
        every = held([*others, replace(last, error=last.error + fallen)])
        best = int(np.argmax(every.size))
        other = every.alternatives[best]
        assert (other.kind, other.owner) == (mistakes.BIAS_STEP, f"{last.run}.Qx")
        assert other.at == pytest.approx(at, abs=1e-9 * high)
        assert float(every.value[best]) == pytest.approx(SIZE, rel=1e-3)
