"""pbonet beside other programs that answer the same question, in one run.

One file for each question: `sets_between_processes`, `pipeline_of_three` and
`modules_in_one_process`. One file for each rival: how that rival does it, the fastest
way that its documentation names.
"""
