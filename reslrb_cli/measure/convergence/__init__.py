"""Error against run time: what each method costs, and how fast the error of the average of its steps falls.

`setup` has who takes part, what is found out before, and the steps that the processes take, `session` has them take
turns, `statistics` has errors, slopes and efficiencies, and `judgement` what comes of it all. What is measured is the
`Plan` of `measure/methods.py`.
"""
