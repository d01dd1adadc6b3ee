"""Edit your capture: python examples/edit_a_scene.py CAPTURE "make it red" edited.ply

CAPTURE is a transforms.json, its folder, or a COLMAP folder.
"""

import sys

from attnwarp.editing.small import load_editor
from attnwarp.fit import FitSettings, first_splats, fit, load_views
from attnwarp.io import read_dataset, write_ply
from attnwarp.methods import attention_warping, preset
from attnwarp.reporting import reporter

capture, instruction, out = sys.argv[1:]
dataset = read_dataset(capture)
views = load_views(dataset)
of_fit = FitSettings(iterations=500, max_splats=20_000)
start = first_splats(dataset, views.cameras, of_fit)
editor = load_editor("small-plain")  # or a folder of InstructPix2Pix in diffusers' format
settings = preset("attention_warping", "corrected", stages=2, steps=10, iterations=50)
with reporter() as report:  # how far it is
    splats = fit(start, views, of_fit, report=report).gaussians
    result = attention_warping(
        splats, views.cameras, views.images, editor, instruction, settings, report=report
    )
write_ply(out, result.gaussians)
psnr = result.edit_psnr["pooled"]
print(f"{out}: {len(result.edited)} edited views, which its renders follow to {psnr:.1f} dB")
