"""Tokenizer that a recipe learns from its own sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tokenizers import (
    Tokenizer,
    decoders,
    models,
    normalizers,
    pre_tokenizers,
    processors,
    trainers,
)


def learn_byte_pairs(corpus: Iterable[str], *, vocabulary: int, length: int) -> Tokenizer:
    """Byte-level byte pairs: any text can be encoded, and a word of the corpus takes a token or two.

    Args:
        vocabulary: how many tokens there are; 0 pads and 1 ends a sentence.
        length: number of tokens to which every sentence is padded or cut.
    """
    tokenizer = Tokenizer(models.BPE())
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=True)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=vocabulary,
        special_tokens=["<pad>", "<end>"],
        initial_alphabet=pre_tokenizers.ByteLevel.alphabet(),
        show_progress=False,
    )
    tokenizer.train_from_iterator(corpus, trainer)
    tokenizer.post_processor = processors.TemplateProcessing(
        single="$A <end>", special_tokens=[("<end>", 1)]
    )
    tokenizer.enable_padding(pad_id=0, pad_token="<pad>", length=length)
    tokenizer.enable_truncation(length)
    return tokenizer


def tokens_of(tokenizer: Tokenizer, texts: Sequence[str]) -> torch.Tensor:
    """(N, L) int64, padded with 0."""
    codes = tokenizer.encode_batch(list(texts))
    return torch.tensor([code.ids for code in codes], dtype=torch.int64)
