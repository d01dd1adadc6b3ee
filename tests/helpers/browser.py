"""A headless Chromium, driven through its DevTools protocol."""

import asyncio
import base64
import os
import shutil
import signal
import subprocess
import tempfile
import time
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")


def executable():
    """Path of a Chromium; None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Tab:
    """A page that is open in the browser."""

    def __init__(self, socket):
        self.socket, self.number = socket, 0

    async def send(self, method, **params):
        self.number += 1
        await self.socket.send_json({"id": self.number, "method": method, "params": params})
        while True:
            message = await self.socket.receive_json()
            if message.get("id") == self.number:
                assert "error" not in message, message
                return message["result"]

    async def run(self, script):
        """Value of a JavaScript expression."""
        answer = await self.send("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def until(self, script, seconds=600):
        """Wait until an expression is true, and return its value."""
        end = time.monotonic() + seconds
        while not (value := await self.run(script)):
            assert time.monotonic() < end, f"{script} is still {value!r}"
            await asyncio.sleep(0.2)
        return value

    async def picture(self):
        """(H, W, 3) uint8 of the page."""
        import cv2

        data = base64.b64decode((await self.send("Page.captureScreenshot"))["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    async def mouse(self, kind, x, y):
        await self.send(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left",
            buttons=1 if kind == "mousePressed" else 0, clickCount=1,
        )  # fmt: skip

    async def click(self, x, y):
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            await self.mouse(kind, x, y)
            await asyncio.sleep(0.1)

    async def press(self, key, code):
        for kind in ("keyDown", "keyUp"):
            await self.send(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key,
                windowsVirtualKeyCode=code,
                # Without its text, Enter presses no button.
                **({"text": "\r"} if (kind, key) == ("keyDown", "Enter") else {}),
            )  # fmt: skip


@asynccontextmanager
async def opened(url, size=(900, 600), profile=None):
    """A tab at an address, in a browser of its own that is killed behind it; ``profile`` is a
    folder that outlives it.
    """
    import aiohttp

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as passing:
        folder = profile or passing
        Path(folder, "DevToolsActivePort").unlink(missing_ok=True)  # of the browser before
        process = subprocess.Popen(
            [
                executable(), "--headless", "--no-sandbox", "--disable-gpu-sandbox",
                "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                f"--window-size={size[0]},{size[1]}", "--remote-debugging-port=0",
                f"--user-data-dir={folder}", "about:blank",
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        try:
            port = Path(folder, "DevToolsActivePort")
            end = time.monotonic() + 300
            while not (port.is_file() and port.read_text().count("\n")):
                assert time.monotonic() < end and process.poll() is None
                await asyncio.sleep(0.1)
            base = f"http://127.0.0.1:{port.read_text().splitlines()[0]}"
            async with aiohttp.ClientSession() as session:
                async with session.get(f"{base}/json") as answer:
                    pages = [page for page in await answer.json() if page["type"] == "page"]
                address = pages[0]["webSocketDebuggerUrl"]
                async with session.ws_connect(address, max_msg_size=0) as socket:
                    tab = Tab(socket)
                    await tab.send("Page.enable")
                    await tab.send("Page.navigate", url=url)
                    yield tab
        finally:
            # Debian's browser is started by a script, which does not pass a signal on.
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(30)
