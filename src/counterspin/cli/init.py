"""`counterspin init`: a commented campaign to start from, or one made of a recorder's files."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from cyclopts import Parameter

from counterspin.cli.common import command, print_output, shell_word
from counterspin.errors import CampaignError, CounterspinError, UsageError
from counterspin.ingest.starter import Test

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from counterspin.ingest.contents import FileContents
    from counterspin.ingest.questions import FileQuestion


@command
def init(
    directory: Path,
    /,
    *,
    test: Test | None = None,
    from_: Annotated[list[Path] | None, Parameter(name="--from", consume_multiple=True)] = None,
    yes: bool = False,
    answer: Annotated[list[str] | None, Parameter(consume_multiple=False)] = None,
) -> None:
    """Write a commented campaign: an example, or a campaign for your data files.

    Parameters
    ----------
    directory
        Folder for campaign.toml. counterspin creates the folder if it does not exist.
    test
        Kind of test: records of a double turntable, readings of a multi-position tumble, readings
        on the arm of a centrifuge, or a record of a three-axis sensor in many poses. Default:
        double-turntable; with --from, the detected kind.
    from_
        Data files, one for each run, or a table of readings from a tumble or an arm. counterspin
        prints their contents and prompts for the kind of test and the missing information.
    yes
        Do not prompt. Stop with an error if any information is missing.
    answer
        Answer to a prompt, such as --answer "radius=2.5 m"; may be repeated.
    """
    if from_:
        _import_files(directory, from_, answer or [], test, asks_questions=not yes)
        return
    if yes or answer:
        raise UsageError("init", ["give the recorder files: --from FILE ..."])
    from counterspin.ingest.starter import init as run

    written = run(directory, test or "double-turntable")
    _write_schema(directory)
    print_output(
        f"Wrote {written}. Edit this file, or try the example:",
        f"  counterspin simulate {shell_word(written)} -o {shell_word(directory / 'simulated')}",
        f"  counterspin calibrate {shell_word(directory / 'simulated')}",
    )


def _write_schema(directory: Path) -> None:
    """Write the schema that a description's first line names, so that editors find it."""
    from counterspin.ingest.starter import SCHEMA_NAME
    from counterspin.output import write_text
    from counterspin.schemas import schema_text

    if not (directory / SCHEMA_NAME).exists():
        write_text(directory / SCHEMA_NAME, schema_text("campaign"))


def _import_files(
    directory: Path,
    files: list[Path],
    answer_options: list[str],
    stated_test: Test | None,
    *,
    asks_questions: bool,
) -> None:
    """Write a campaign of a recorder's files."""
    from counterspin.ingest.contents import read_files
    from counterspin.ingest.description import make_draft, write_description
    from counterspin.ingest.overview import overview, sensor_question
    from counterspin.reports.text import work_progress

    answers = _parse_answers(answer_options)
    with work_progress("Files") as advance:
        all_contents = read_files(files, answers, progress=advance)
    print_output("Detected in the files:", *(f"  {line}" for line in overview(all_contents)))
    asks_questions = asks_questions and sys.stdin is not None and sys.stdin.isatty()
    if (question := sensor_question(all_contents)) is not None:
        if not asks_questions:
            example = f'"select={question.example}"'
            text = f"{question.text} Set this value with `answer`, for example {example}."
            raise CampaignError("init", [f"select: {text}"], code="missing-answer")
        answers["select"] = _ask(question)
        all_contents = read_files(files, answers)
    answers.pop("select", None)
    test = stated_test or _choose_test(all_contents, asks=asks_questions)
    detected_test = make_draft(all_contents, answers, test)
    print_output(
        f"Detected for the test {test} (please check):",
        *(f"  {s}" for s in detected_test.statements),
    )
    if asks_questions and not detected_test.problems:
        previous = detected_test.statements
        while detected_test.open_questions:
            question = detected_test.open_questions[0]
            answers[question.key] = _ask(question)
            if question.key == "sheet":
                all_contents = read_files(files, answers)
            detected_test = make_draft(all_contents, answers, test)
        extra = [statement for statement in detected_test.statements if statement not in previous]
        print_output(*(f"  {statement}" for statement in extra))
    try:
        written = write_description(detected_test, directory)
    except CampaignError as error:
        questions = {f"{question.key}: ": question for question in detected_test.open_questions}
        problems = map(partial(_name_option, questions), error.problems)
        raise type(error)("init", problems, code=error.codes) from None
    print_output(
        f"Wrote {written}. Check this file, then calibrate:",
        f"  counterspin calibrate {shell_word(directory)}",
    )


def _name_option(questions: Mapping[str, FileQuestion], problem: str) -> str:
    """Return a problem with the option that answers its question."""
    question = next((q for start, q in questions.items() if problem.startswith(start)), None)
    if question is None:
        return problem
    return (
        f'{problem} Set this value with `answer`, for example "{question.key}={question.example}".'
    )


def _choose_test(all_contents: Sequence[FileContents], *, asks: bool) -> Test:
    """Return the kind of test: a person's choice, or without one the likely kind."""
    from counterspin.ingest.overview import kind_question, likely_test, no_test_reasons

    likely = likely_test(all_contents)
    question = kind_question(likely)
    reasons = [] if likely else list(no_test_reasons(all_contents))
    if asks:
        print_output(*reasons)
        return cast("Test", _ask(question))
    if likely is None:
        text = (
            f"{question.text} Choose a test type with `test`. The files do not identify the "
            f"test type: {'; '.join(reasons)}"
        )
        raise CampaignError("init", [f"test: {text}"], code="missing-answer")
    return likely


def _parse_answers(given: list[str]) -> dict[str, str]:
    answers = {}
    for words in given:
        key, mark, value = words.partition("=")
        if not mark or not value.strip():
            raise UsageError("init", [f'answer: "{words}" is not of the form KEY=VALUE'])
        answers[key.strip()] = value.strip()
    return answers


def _ask(question: FileQuestion) -> str:
    """Return a person's answer; repeat the question until the answer is valid."""
    hint = " or ".join(question.choices) or f"for example {question.example}"
    default = f"; Enter: {question.guess}" if question.guess else ""
    print_output(f"{question.text} ({hint}{default})")
    while True:
        try:
            answer = input("> ").strip() or question.guess or ""
        except EOFError:
            raise CounterspinError(
                "no answer was given, so nothing was written", code="missing-answer"
            ) from None
        try:
            return question.judged(answer)
        except ValueError as error:
            print_output(f"{error}. Try again:")
