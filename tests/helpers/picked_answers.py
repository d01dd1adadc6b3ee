"""The answer that a noise picks, from the definition: one noise and one list at a time."""

from training.editors.answers import codes


def picked(noise, candidates):
    """The look among ``candidates`` whose direction is nearest to the (48, h, w) noise's mean."""
    scores = codes()[list(candidates)] @ noise.mean(dim=(1, 2))
    return int(candidates[int(scores.argmax())])
