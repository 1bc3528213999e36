"""From healthy recordings of a machine to what its monitor compares later data with.

`healthy` turns recordings into hops, `checks` says whether they are fit, `identified` and the baselines of
`models.diagnosis` are what is learned, `commissioned` is the file that holds it.
"""
