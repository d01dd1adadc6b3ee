"""An edit carried to other views beside the same views edited alone, without true pictures."""
