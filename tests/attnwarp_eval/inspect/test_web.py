"""The served page's arguments. Oracle: the parser of trame's server itself."""

import pytest


@pytest.mark.parametrize("secret", ["aZ09_-x", "-begins-with-a-dash", "--two"])
def test_any_secret_reaches_the_server(secret):
    from trame.app import get_server

    from attnwarp_eval.inspect.web import server_arguments

    parser = get_server(f"test-{secret}").cli
    parsed, rest = parser.parse_known_args(server_arguments(secret))
    assert parsed.authKey == secret and not rest
