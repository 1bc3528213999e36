"""A machine without parameters: relations learned on its healthy recordings, and later windows read against them.

See ``docs/decisions/0012-a-machine-without-parameters.md`` for the method and its measured performance.
"""
