"""Applying a result: indicated specific force, corrected.

- `apply`: in memory
- `related`: what an applied result needs beside it: how warm it was, and how errors are related
- `apply_file`: a column of a file, corrected in a new file
- `page`: what was done, as a person reads it
"""
