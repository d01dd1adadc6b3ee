"""Small random Grounding DINO and SAM, saved by transformers' own savers in the published formats."""

import torch
from transformers import (
    BertConfig,
    BertTokenizer,
    GroundingDinoConfig,
    GroundingDinoForObjectDetection,
    GroundingDinoProcessor,
    SamConfig,
    SamModel,
    SamProcessor,
    SwinConfig,
)
from transformers.models.grounding_dino.image_processing_pil_grounding_dino import (
    GroundingDinoImageProcessorPil,
)
from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil
from transformers.utils import logging

logging.set_verbosity_error()
logging.disable_progress_bar()

WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "bear", "a", "red", "mug")


def tokenizer():
    return BertTokenizer(vocab={word: i for i, word in enumerate(WORDS)}, model_max_length=32)


def save_dino(folder, *, seed=0, sharpness=1.0):
    """A detector with 7 queries; ``sharpness`` multiplies its text features, so that scores spread."""
    torch.manual_seed(seed)
    text = BertConfig(
        vocab_size=len(WORDS), hidden_size=32, intermediate_size=37, num_hidden_layers=2, num_attention_heads=4,
        max_position_embeddings=64,
    )  # fmt: skip
    vision = SwinConfig(
        image_size=64, embed_dim=16, depths=(1, 1, 1), num_heads=(2, 2, 2), window_size=4, out_features=["stage2", "stage3"],
    )  # fmt: skip
    config = GroundingDinoConfig(
        backbone_config=vision, text_config=text, d_model=32, encoder_layers=2, encoder_ffn_dim=48, encoder_attention_heads=4,
        decoder_layers=2, decoder_ffn_dim=48, decoder_attention_heads=4, num_queries=7, num_feature_levels=3,
        encoder_n_points=2, decoder_n_points=2, max_text_len=32,
    )  # fmt: skip
    model = GroundingDinoForObjectDetection(config).eval()
    processor = GroundingDinoProcessor(
        GroundingDinoImageProcessorPil(size={"shortest_edge": 48, "longest_edge": 96}), tokenizer()
    )
    with torch.no_grad():
        model.model.text_projection.weight.mul_(sharpness)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return model, processor


def save_sam(folder, *, seed=0):
    """A SAM for pictures of 64 px."""
    torch.manual_seed(seed)
    config = SamConfig(
        vision_config={
            "hidden_size": 32, "output_channels": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 64,
            "patch_size": 8, "window_size": 4, "global_attn_indexes": [1], "mlp_dim": 48, "num_pos_feats": 8,
        },
        prompt_encoder_config={"hidden_size": 16, "image_size": 64, "patch_size": 8, "image_embedding_size": 8, "mask_input_channels": 4},
        mask_decoder_config={
            "hidden_size": 16, "mlp_dim": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "iou_head_hidden_dim": 16,
        },
    )  # fmt: skip
    model = SamModel(config).eval()
    processor = SamProcessor(
        SamImageProcessorPil(
            size={"longest_edge": 64},
            pad_size={"height": 64, "width": 64},
            mask_size={"longest_edge": 16},
            mask_pad_size={"height": 16, "width": 16},
        )
    )
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return model, processor
