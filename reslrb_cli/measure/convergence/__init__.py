"""Error against run time: what each method costs, and how fast the error of the average of its steps falls.

`plan` says what is measured, `survey` and `sampler` are what the processes do, `session` has them take turns, `curves`
and `judgement` are the statistics, `results` what comes of it all.
"""
