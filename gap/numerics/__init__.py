import makebreak.systems.numerics.code_cache  # noqa: F401  (before its functions)
