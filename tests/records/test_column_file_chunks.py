"""Chunks of a record."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from counterspin.records.column_file import iter_chunks


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 90_000), min_size=1, max_size=6), st.integers(1, 70_000))
def test_chunks_contain_every_row_once_in_order(lengths, size):
    ends = np.cumsum([0, *lengths])
    columns = {"b": np.arange(ends[-1], dtype=float), "a": -np.arange(ends[-1], dtype=float)}
    batches = ({name: x[a:b] for name, x in columns.items()} for a, b in pairwise(ends))
    chunks = [
        {name: x.copy() for name, x in chunk.items()}
        for chunk in iter_chunks(batches, lambda _: size)
    ]
    assert [len(chunk["a"]) for chunk in chunks[:-1]] == [size] * (len(chunks) - 1)
    if chunks:
        for name, expected in columns.items():
            np.testing.assert_array_equal(np.concatenate([p[name] for p in chunks]), expected)
    else:
        assert ends[-1] == 0
