"""The laboratory: research on the method and on its metrics, beside the instrument that it uses.

- :mod:`attnwarp_lab.ideal`: the ideal editor, a thing in parts, labels of the parts.
- :mod:`attnwarp_lab.probes`: probes of studies, which enter by the door of plugins.
- :mod:`attnwarp_lab.captures`: methods on captures, and the paper's tables.
- :mod:`attnwarp_lab.userstudy`: a page that asks people, and the score of their answers.
- :mod:`attnwarp_lab.cli`: its commands of attnwarp-eval.
"""
