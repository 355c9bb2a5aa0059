"""Record files of Parquet."""

from record_files import SIGNAL, refusal, table, write


def test_text_column_of_parquet(tmp_path):
    columns = {**table(), SIGNAL: ["x"] * 1000}
    assert "String" in refusal(write(tmp_path / "run.parquet", columns))
