"""Masks at feature size, against torch and by hand."""

import torch

from attnwarp.warp.masks import resize_mask


def test_a_mask_at_feature_size_counts_what_it_covers():
    mask = torch.zeros(8, 8, dtype=torch.bool)
    mask[:, :4] = True
    mask[3:5, 4:] = (
        True  # what the bilinear 4 pixels around the middle of the right half see, a quarter of its area
    )
    assert resize_mask(mask, (1, 2)).tolist() == [[True, False]]
    assert resize_mask(mask, (1, 2), "bilinear").tolist() == [[True, True]]
    assert resize_mask(mask, (1, 2), "nearest").tolist() == [[True, True]]
    half = torch.tensor([[True, False]])
    assert not resize_mask(half, (1, 1)).any()  # a half is not more than half
    for mode in ("area", "bilinear", "nearest"):
        assert torch.equal(resize_mask(mask, (8, 8), mode), mask)


def test_resizing_a_mask_agrees_with_torch():
    mask = torch.rand(96, 64, generator=torch.Generator().manual_seed(0)) > 0.45
    full = mask.double()[None, None]
    area = torch.nn.functional.interpolate(full, size=(12, 16), mode="area")[0, 0]
    bilinear = torch.nn.functional.interpolate(
        full, size=(12, 16), mode="bilinear", align_corners=False
    )[0, 0]
    assert torch.equal(resize_mask(mask, (12, 16)), area > 0.5)
    assert torch.equal(resize_mask(mask, (12, 16), "bilinear"), bilinear > 0.5)
    # Overlaps that are not whole: each third of 4 pixels covers 1 and a third of them.
    row = torch.tensor([[True, False, False, True]])
    assert resize_mask(row, (1, 3)).tolist() == [[True, False, True]]
