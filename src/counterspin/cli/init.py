"""`counterspin init`: a commented example campaign, or a campaign for data files."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from cyclopts import Parameter

from counterspin.cli.common import (
    command,
    make_prompts_interruptible,
    print_output,
    quote_path,
)
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
        Test type: records of a double turntable, readings of a multi-position tumble, readings
        on the arm of a centrifuge, or a record of a three-axis sensor in many poses. Default:
        double-turntable; with --from, the detected test type.
    from_
        Data files, one for each run, or a table of readings from a tumble or an arm. counterspin
        prints their contents and prompts for the test type and the missing information.
    yes
        Do not prompt. Stop with an error if any information is missing.
    answer
        Answer to a prompt, such as --answer "radius=2.5 m"; may be repeated.
    """
    if from_:
        _import_files(directory, from_, answer or [], test, is_interactive=not yes)
        return
    if yes or answer or from_ is not None:
        raise UsageError("init", ["give the data files: --from FILE ..."])
    from counterspin.ingest.starter import init as write_starter

    path = write_starter(directory, test or "double-turntable")
    _write_schema(directory)
    print_output(
        f"Wrote {path}. Edit this file, or try the example:",
        f"  counterspin simulate {quote_path(path)} -o {quote_path(directory / 'simulated')}",
        f"  counterspin calibrate {quote_path(directory / 'simulated')}",
    )


def _write_schema(directory: Path) -> None:
    """Write the schema named in the first line of a description, for editors."""
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
    is_interactive: bool,
) -> None:
    """Write a campaign for data files."""
    from counterspin.ingest.contents import read_files
    from counterspin.ingest.description import make_draft, write_description
    from counterspin.ingest.overview import describe_files, make_sensor_question
    from counterspin.reports.text import show_work_progress

    answers = _parse_answers(answer_options)
    with show_work_progress("Files") as advance:
        contents = read_files(files, answers, progress=advance)
    print_output("Detected in the files:", *(f"  {line}" for line in describe_files(contents)))
    is_interactive = is_interactive and sys.stdin is not None and sys.stdin.isatty()
    if (question := make_sensor_question(contents)) is not None:
        if not is_interactive:
            example = f'"select={question.example}"'
            message = f"{question.text} Set this value with `answer`, for example {example}."
            raise CampaignError("init", [f"select: {message}"], code="missing-answer")
        answers["select"] = _prompt(question)
        contents = read_files(files, answers)
    answers.pop("select", None)
    test = stated_test or _choose_test(contents, is_interactive=is_interactive)
    draft = make_draft(contents, answers, test)
    print_output(
        f"Detected for the test type {test} (please check):", *(f"  {s}" for s in draft.statements)
    )
    if is_interactive and not draft.problems:
        printed_statements = draft.statements
        while draft.open_questions:
            question = draft.open_questions[0]
            answers[question.key] = _prompt(question)
            if question.key == "sheet":
                contents = read_files(files, answers)
            draft = make_draft(contents, answers, test)
        new_statements = [
            statement for statement in draft.statements if statement not in printed_statements
        ]
        print_output(*(f"  {statement}" for statement in new_statements))
    try:
        campaign_file = write_description(draft, directory)
    except CampaignError as error:
        questions = {f"{question.key}: ": question for question in draft.open_questions}
        problems = map(partial(_add_option, questions), error.problems)
        raise type(error)("init", problems, code=error.codes) from None
    print_output(
        f"Wrote {campaign_file}. Check this file, then calibrate:",
        f"  counterspin calibrate {quote_path(directory)}",
    )


def _add_option(questions: Mapping[str, FileQuestion], problem: str) -> str:
    """Return a problem, with the option that answers its question added."""
    question = next((q for prefix, q in questions.items() if problem.startswith(prefix)), None)
    if question is None:
        return problem
    sentence = problem if problem.endswith((".", "?")) else f"{problem}."
    return (
        f'{sentence} Set this value with `answer`, for example "{question.key}={question.example}".'
    )


def _choose_test(contents: Sequence[FileContents], *, is_interactive: bool) -> Test:
    """Return the test type: chosen by the user, or else detected."""
    from counterspin.ingest.overview import explain_unknown_test, guess_test, make_test_question

    detected_test = guess_test(contents)
    question = make_test_question(detected_test)
    reasons = [] if detected_test else list(explain_unknown_test(contents))
    if is_interactive:
        print_output(*reasons)
        return cast("Test", _prompt(question))
    if detected_test is None:
        message = (
            f"{question.text} Choose a test type with `test`. The files do not identify the "
            f"test type: {'; '.join(reasons)}"
        )
        raise CampaignError("init", [f"test: {message}"], code="missing-answer")
    return detected_test


def _parse_answers(answer_options: list[str]) -> dict[str, str]:
    answers: dict[str, str] = {}
    for option in answer_options:
        key, separator, value = option.partition("=")
        if not separator or not value.strip():
            raise UsageError("init", [f'answer: "{option}" is not of the form KEY=VALUE'])
        if answers.setdefault(key.strip(), value.strip()) != value.strip():
            raise UsageError("init", [f"answer: {key.strip()} has two different answers"])
    return answers


def _prompt(question: FileQuestion) -> str:
    """Prompt for an answer until it is valid, and return it."""
    hint_text = " or ".join(question.choices) or f"for example {question.example}"
    default_text = f"; Enter: {question.guess}" if question.guess else ""
    print_output(f"{question.text} ({hint_text}{default_text})")
    make_prompts_interruptible()
    while True:
        try:
            answer = input("> ").strip() or question.guess or ""
        except EOFError:
            raise CounterspinError(
                "no answer was given, so nothing was written", code="missing-answer"
            ) from None
        try:
            return question.parse_answer(answer)
        except ValueError as error:
            print_output(f"{error}. Try again:")
