"""Tests of jobs in chunks, and of what is built on them."""
