"""Small random networks, saved by the real savers in the real formats."""

import json

import torch
from torch import nn
from transformers import (
    CLIPConfig,
    CLIPModel,
    CLIPTokenizer,
    Dinov2Config,
    Dinov2Model,
    Dinov2WithRegistersConfig,
    Dinov2WithRegistersModel,
)
from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil
from transformers.utils import logging

logging.set_verbosity_error()
logging.disable_progress_bar()

IMAGENET_MEAN, IMAGENET_STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


def tokens():
    """Every byte, alone and at a word's end, one merged word, and the two marks at the end, as in
    CLIP's own.
    """
    from tokenizers.pre_tokenizers import ByteLevel

    letters = sorted(ByteLevel.alphabet())
    known = [
        *letters,
        *(f"{c}</w>" for c in letters),
        "be",
        "ar</w>",
        "bear</w>",
        "<|startoftext|>",
        "<|endoftext|>",
    ]
    return {token: i for i, token in enumerate(known)}, [
        ("b", "e"),
        ("a", "r</w>"),
        ("be", "ar</w>"),
    ]


def tokenizer():
    vocab, merges = tokens()
    return CLIPTokenizer(vocab=vocab, merges=merges)


def save_clip(folder, *, seed=0, side=32, length=24, **processor):
    """A CLIP of 2 + 2 layers; the model, its processor and its tokenizer, all as transformers has
    them.
    """
    vocab, _ = tokens()
    torch.manual_seed(seed)
    layers = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    last = len(vocab) - 1
    model = CLIPModel(
        CLIPConfig(
            text_config={
                **layers, "vocab_size": len(vocab), "max_position_embeddings": length,
                "eos_token_id": last, "bos_token_id": last - 1, "pad_token_id": last,
            },
            vision_config={**layers, "image_size": side, "patch_size": 8},
            projection_dim=24,
        )
    ).eval()  # fmt: skip
    square = {"height": side, "width": side}
    pictures = CLIPImageProcessorPil(
        **{"size": {"shortest_edge": side}, "crop_size": square, **processor}
    )
    words = tokenizer()
    for part in (model, pictures, words):
        part.save_pretrained(folder)
    return model, pictures, words


def save_dino(folder, *, registers, seed=0):
    """A DINOv2 of 2 layers for 28 px, seen at 42 px, so that its positions are interpolated as the
    real one's are.
    """
    torch.manual_seed(seed)
    said = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_ratio": 2}
    said |= {"image_size": 28, "patch_size": 14}
    if registers:
        model = Dinov2WithRegistersModel(
            Dinov2WithRegistersConfig(**said, num_register_tokens=4)
        ).eval()
    else:
        model = Dinov2Model(Dinov2Config(**said)).eval()
    with (
        torch.no_grad()
    ):  # layer scale starts at 1 and class tokens at nearly 0: all pictures would look alike
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    # What the published folders hold, which the saver here would name otherwise.
    processor = {
        "crop_size": {"height": 42, "width": 42},
        "do_center_crop": True,
        "do_convert_rgb": True,
        "do_normalize": True,
        "do_rescale": True,
        "do_resize": True,
        "image_mean": IMAGENET_MEAN,
        "image_processor_type": "BitImageProcessor",
        "image_std": IMAGENET_STD,
        "resample": 3,
        "rescale_factor": 0.00392156862745098,
        "size": {"shortest_edge": 48},
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return model, processor


def torchvision_features(name):
    """``torchvision.models.<name>().features`` layer by layer, spelt out, pools and all."""
    C, R = nn.Conv2d, nn.ReLU
    if name == "alexnet":
        return nn.Sequential(
            C(3, 64, kernel_size=11, stride=4, padding=2),
            R(),
            nn.MaxPool2d(kernel_size=3, stride=2),
            C(64, 192, kernel_size=5, padding=2),
            R(),
            nn.MaxPool2d(kernel_size=3, stride=2),
            C(192, 384, kernel_size=3, padding=1),
            R(),
            C(384, 256, kernel_size=3, padding=1),
            R(),
            C(256, 256, kernel_size=3, padding=1),
            R(),
            nn.MaxPool2d(kernel_size=3, stride=2),
        )
    layers, inputs = [], 3
    for outputs, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(count):
            layers += [C(inputs, outputs, kernel_size=3, padding=1), R()]
            inputs = outputs
        layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
    return nn.Sequential(*layers)


TORCHVISION = {"alex": "alexnet", "vgg": "vgg16"}


def save_backbone(path, name, seed=0):
    """Random weights in the file that torchvision publishes; the features are returned."""
    torch.manual_seed(seed)
    features = torchvision_features(TORCHVISION[name])
    state = {f"features.{key}": value for key, value in features.state_dict().items()}
    torch.save(state | {"classifier.1.weight": torch.zeros(2, 2)}, path)
    return features.eval()


def linear_layers():
    """The folder of the published linear layers, which torchmetrics carries."""
    from pathlib import Path

    from torchmetrics.functional.image import lpips

    return Path(lpips.__file__).parent / "lpips_models"
