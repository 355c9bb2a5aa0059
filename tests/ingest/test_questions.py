"""What an answer means."""

import pytest

from counterspin.ingest.questions import AXES, SENSES, FileQuestion, parse_answers

GRAVITY = FileQuestion("gravity", "?", "9.8066 ± 1e-5 m/s^2", quantity="m/s^2")
LATITUDE = FileQuestion("latitude", "?", "45.75 deg", quantity="rad")
RADIUS = FileQuestion("radius", "?", "2.5 m", quantity="m")
RATE = FileQuestion("rate", "?", "0.25 rev/s", quantity="rad/s")
AXIS = FileQuestion("axis", "?", "east", AXES)
SENSE = FileQuestion("sense", "?", "clockwise", SENSES)
UNIT = FileQuestion("unit", "?", "m", unit="m")
COUNTS = FileQuestion("counts", "?", "65536")


@pytest.mark.parametrize(
    ("question", "answer", "meaning"),
    [
        (GRAVITY, "9,8073", "9.8073 m/s^2"),
        (GRAVITY, "9.8073 ± 1e-5", "9.8073 ± 1e-5 m/s^2"),
        (GRAVITY, "980.73 cm/s^2", "980.73 cm/s^2"),
        (LATITUDE, "45,75", "45.75 deg"),
        (LATITUDE, "45 deg 45 min S", "-45.75 deg"),
        (AXIS, "North", "north"),
        (AXIS, "O", "east"),
        (AXIS, "n", "north"),
        (SENSE, "ccw", "counterclockwise"),
        (UNIT, "[mm]", "mm"),
        (COUNTS, "4096", "4096"),
    ],
)
def test_answer_spellings_are_accepted(question, answer, meaning):
    assert question.parse_answer(answer) == meaning


@pytest.mark.parametrize(
    ("question", "answer", "message"),
    [
        (GRAVITY, "9.8 m", "acceleration"),
        (GRAVITY, "50", "50 m/s.2 is not a possible value of gravity"),
        (LATITUDE, "100 deg", "a latitude must be between -90 deg and 90 deg"),
        (RADIUS, "-2 m", "must be greater than zero"),
        (RATE, "30", "has no unit"),  # revolutions a minute as likely as degrees a second
        (AXIS, "noth", "did you mean 'north'"),
        (UNIT, "s", "is not a unit of length"),
        (COUNTS, "-4", "positive"),
        (COUNTS, "many", "not a positive number; enter, for example, 65536"),
        (COUNTS, "inf", "not a positive number"),
    ],
)
def test_invalid_answers_raise(question, answer, message):
    with pytest.raises(ValueError, match=message):
        question.parse_answer(answer)


def test_unknown_question_is_reported():
    taken, problems = parse_answers([GRAVITY, AXIS], {"axis": "e", "gravty": "9.8"})
    assert taken == {"axis": "east"}
    assert problems == ["gravty: not one of the questions: gravity, axis"]
