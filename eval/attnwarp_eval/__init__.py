"""The evaluation harness: scenes with exact truth, and figures of a method against it.

- :mod:`attnwarp_eval.scene` and :mod:`attnwarp_eval.truth`: scenes, and their exact
  truth.
- :mod:`attnwarp_eval.metrics`: figures of depth, warps, masks and edited views.
- :mod:`attnwarp_eval.study`: runs of scenes x variants x seeds x probes.
- :mod:`attnwarp_eval.report` and :mod:`attnwarp_eval.compare`: the report of a run, and comparisons
  with a baseline.
- :mod:`attnwarp_eval.inspect`: a warp in 3D.
- :mod:`attnwarp_eval.stability`: hard inputs, swept until they break.
"""
