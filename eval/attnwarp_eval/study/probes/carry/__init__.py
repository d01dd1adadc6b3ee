"""An edit carried to other views against the same views edited alone, without true pictures."""
