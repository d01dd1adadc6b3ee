"""Score renders of an edited scene: python examples/score_pictures.py RENDERS EDITED

Both are folders of pictures with the same names.
"""

import sys
from pathlib import Path

from attnwarp.io import read_image
from attnwarp_eval.metrics import edit_psnr

renders, edited = (
    {path.stem: read_image(path) / 255 for path in sorted(Path(folder).glob("*.png"))}
    for folder in sys.argv[1:]
)
score = edit_psnr(edited, renders)
print(f"Edit PSNR of {len(score.views)} views: {score.pooled:.2f} dB, pooled over their pixels")
