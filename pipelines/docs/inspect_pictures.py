"""Take the pictures of the inspection page for the docs: galleries, a grasp, a prediction, a scene.

Input: a dataset's directory, and the results of `drakegrasp verify` for some of its rows. Output:
one picture of each page, `inspect_NAME.png`. Predictions and scenes are left out if there are none.
The script needs Playwright and the system's Chromium (`make test-browser` installs both).
"""

from __future__ import annotations

import argparse
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path

import uvicorn
from playwright.sync_api import sync_playwright

from drakegrasp.page.app import Inspection, listen, make_app
from drakegrasp.page.attempts import AttemptGallery
from drakegrasp.page.predictions import Predictions
from drakegrasp.page.scenes import Scenes

#: Chromium cannot use its sandbox when it runs as root; the CPU computes WebGL.
OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
#: Size of a picture [px].
WIDTH, HEIGHT = 1280, 900
#: Maximum wait for anything on a page [ms].
PATIENCE = 60_000.0


def main(argv: Sequence[str] | None = None) -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="directory of a dataset")
    parser.add_argument("pictures", type=Path, help="directory for the pictures")
    parser.add_argument("--predictions", type=Path, help="file that verify --out has written")
    arguments = parser.parse_args(argv)

    # Serve the dataset from a thread.
    listener = listen(0)
    inspection = Inspection(arguments.out, arguments.predictions)
    server = uvicorn.Server(uvicorn.Config(make_app(inspection), log_level="error"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    address = f"http://127.0.0.1:{listener.getsockname()[1]}"

    # Take the pictures: the galleries, the first grasp, the training scene with the most tested
    # grasps, and in the dark theme a lifted prediction that is among the farthest from the stored
    # grasps.
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(OPTIONS))
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(PATIENCE)
        for kind, name, path in (
            (AttemptGallery, "gallery", "/?split=samples"),
            (Scenes, "scenes", "/scenes?split=train&sort=tested"),
            (Predictions, "predictions", "/predictions?verdict=lifted&sort=true_error"),
        ):
            if kind not in inspection.galleries():
                continue
            page.goto(f"{address}{path}")
            page.wait_for_load_state("networkidle")
            page.screenshot(path=arguments.pictures / f"inspect_{name}.png")
            if kind is Predictions:
                page.select_option("#theme", "dark")
            page.click("#cards a")
            page.wait_for_selector("#view3d[data-ready]")
            page.wait_for_load_state("networkidle")
            page.screenshot(path=arguments.pictures / f"inspect_{kind.ROW}.png")
        browser.close()
    server.should_exit = True
    thread.join()


if __name__ == "__main__":
    main()
