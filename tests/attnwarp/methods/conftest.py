from edit_fixtures import editor, one_thread, scene  # noqa: F401
