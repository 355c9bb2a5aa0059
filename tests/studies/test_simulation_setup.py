"""What a study simulates."""

from campaigns import SMALL, write_description
from raising import raises

from counterspin.studies.study import study


def test_trial_with_too_few_samples_raises(tmp_path):
    text = SMALL.replace('sampling_rate = "20 Hz"', 'sampling_rate = "1e-3 Hz"')
    with raises("not-simulable", "runs[0]:", "80 s", "0.001 Hz"):
        study(write_description(tmp_path, text), trials=2)
