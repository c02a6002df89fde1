"""The recursion of a filter, and the ways to predict measurements."""
