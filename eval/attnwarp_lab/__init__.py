"""The laboratory: research on the method and its metrics, built on the instrument.

- :mod:`attnwarp_lab.ideal`: the ideal editor, a thing in parts, places, labels of the parts.
- :mod:`attnwarp_lab.probes`: probes of studies, registered through entry points.
- :mod:`attnwarp_lab.captures`: methods on captures, and the paper's tables.
- :mod:`attnwarp_lab.userstudy`: a page of choices for people, and the score of their answers.
- :mod:`attnwarp_lab.cli`: the laboratory's commands of attnwarp-eval.
"""
