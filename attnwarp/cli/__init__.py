"""The command line: attnwarp. Nothing heavy is imported until a command needs it."""
