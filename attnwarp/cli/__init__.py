"""Command line of attnwarp. Heavy libraries are imported only by the commands that need them."""
