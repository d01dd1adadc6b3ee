"""Qwen-Image-Edit-Plus (Alibaba 2025, releases 2509 and later): edits that see several pictures."""

from __future__ import annotations

from attnwarp.editing.editors import reads
from attnwarp.editing.editors.qwen_image_edit import QwenImageEdit


@reads("QwenImageEditPlusPipeline")
class QwenImageEditPlus(QwenImageEdit):
    """Editor of Qwen-Image-Edit-Plus."""

    pipeline = "QwenImageEditPlusPipeline"
    references = 2
    read_area = 384**2
