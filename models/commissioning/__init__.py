"""From healthy recordings of a machine to the references with which its monitor compares later data.

`healthy` cuts recordings into hops, `checks` decides whether they are suitable, `levels` learns at each knowledge level
(with `identified`, or the baselines of `models.diagnosis`), and `commissioned` is the file with the result.
"""
