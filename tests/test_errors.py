"""Messages of errors that several rooms share."""

from counterspin.errors import describe_read_error


def test_a_missing_file_is_described_in_one_form():
    assert (
        describe_read_error(FileNotFoundError(2, "No such file or directory")) == "file not found"
    )
    assert describe_read_error(PermissionError(13, "denied")) == "cannot be read (denied)"
