#!/usr/bin/env bash
# Install a Chromium for the tests of pages, where there is none.
set -euo pipefail
for name in chromium-headless-shell chromium chromium-browser google-chrome; do
    command -v "$name" >/dev/null && exit 0
done
root=()
[ "$(id -u)" = 0 ] || root=(sudo -n)
if ! { "${root[@]}" apt-get update -qq && "${root[@]}" apt-get install -y -qq chromium-headless-shell; } >&2; then
    echo "attnwarp: tests of pages need a Chromium; install one (Debian: sudo apt-get install chromium-headless-shell)" >&2
    exit 2
fi
