"""The pages in a real browser: Chromium of the system, driven by Playwright.

They skip where there is no Chromium; `make test-browser` installs it on Debian.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np
import pytest
import uvicorn
from helpers.arms import write_arm
from helpers.pages import coded, numbered
from helpers.predictions import write_predictions
from matplotlib.image import imread

from drakegrasp.dataset.rejections import AttemptKey, read_decisions
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.page.app import Inspection, listen, make_app
from drakegrasp.page.snapshot import Snapshot, read_snapshot
from drakegrasp.reach.arm import load_arm
from drakegrasp.reach.rows import reach_dataset
from drakegrasp.simulation.fixtures import load_surroundings

playwright = pytest.importorskip("playwright.sync_api")
Browser, Page = playwright.Browser, playwright.Page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
#: As root Chromium has no sandbox; WebGL is computed by the CPU.
OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
#: Longest wait for anything on a page [ms]; shared machines stall.
PATIENCE = 60_000.0
SIZES = ((390, 844), (1280, 900))
#: A page that is left before it has loaded gives up its requests, and one whose server has ended
#: with its test may still ask for its icon.
HARMLESS = ("GPU stall", "ABORTED", "CONNECTION_REFUSED")

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: make test-browser"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """A page that fails the test if a script does, or if a request leaves its host."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(PATIENCE)
    faults: list[str] = []
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(f"script: {error}"))
    page.on("console", lambda m: faults.append(m.text) if m.type in ("error", "warning") else None)
    page.on("requestfailed", lambda r: faults.append(f"failed, {r.failure}: {r.url}"))
    page.on("dialog", lambda dialog: faults.append(f"dialog: {dialog.message}"))
    page.on("request", lambda r: None if _is_ours(r.url) else faults.append(f"leaves: {r.url}"))
    yield page
    context.close()
    assert not [fault for fault in faults if not any(text in fault for text in HARMLESS)]


def _is_ours(url: str) -> bool:
    return url.startswith(("http://127.0.0.1:", "blob:"))


@pytest.fixture
def state(sound: Path) -> Snapshot:
    """Of the dataset that is shown: objects have codes in addresses."""
    return read_snapshot(sound)


@pytest.fixture
def address(out: Path) -> Iterator[str]:
    with served(out) as address:
        yield address


@contextmanager
def served(out: Path, results: Path | None = None) -> Iterator[str]:
    """Serve a dataset from a thread, with results of predictions; yields its address."""
    listener = listen(0)
    config = uvicorn.Config(make_app(Inspection(out, results)), log_level="error")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(timeout=30.0)
        listener.close()


def wait_for_view(page: Page) -> None:
    page.wait_for_selector("#view3d[data-ready]")


def in_each_size(page: Page) -> Iterator[None]:
    """Yield with each size of the window, in which what the page then shows must fit."""
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        yield
        page.wait_for_load_state("networkidle")
        assert page.evaluate("document.documentElement.scrollWidth") <= width


def views(page: Page, *keys: str) -> int:
    """Return how many different pictures the 3D view shows, at first and after each key."""
    shots = {page.locator("#view3d").screenshot()}
    for key in keys:
        page.keyboard.press(key)
        shots.add(page.locator("#view3d").screenshot())
    return len(shots)


def colours_of(page: Page) -> int:
    """Return how many colours the 3D view shows, counted on a coarse scale."""
    png = page.locator("#view3d").screenshot()
    pixels = (imread(BytesIO(png))[..., :3] * 15.0).astype(int).reshape(-1, 3)
    return len(np.unique(pixels, axis=0))


def labels(page: Page, state: Snapshot) -> list[str]:
    found = page.locator("#cards li").evaluate_all("cards => cards.map(c => c.dataset.label)")
    return [numbered(state, label) for label in found]


def wait_for_decision(out: Path, key: AttemptKey, decision: str) -> None:
    """Wait until the file on disk says what was decided."""
    end = time.monotonic() + PATIENCE / 1e3
    while read_decisions(out / "reject.json").of(key) != decision:
        assert time.monotonic() < end, f"{key} must be {decision!r} on disk"
        time.sleep(0.05)


def wait_until(page: Page, is_so: Callable[[], bool]) -> None:
    """Wait until something is so; the policy of the pages forbids Playwright's own way."""
    end = time.monotonic() + PATIENCE / 1e3
    while not is_so():
        assert time.monotonic() < end
        page.wait_for_timeout(20)


def wait_for_labels(page: Page, state: Snapshot, wanted: list[str]) -> None:
    """Wait until the gallery shows these attempts, in this order."""
    wait_until(page, lambda: labels(page, state) == wanted)


def wait_for_cards(page: Page, count: int) -> None:
    wait_until(page, lambda: page.locator("#cards li").count() == count)


IN_ORDER = ["1-0-0", "1-1-0", "1-3-2"]


def test_filters_act_when_chosen(page: Page, address: str, state: Snapshot) -> None:
    page.goto(address)
    assert len(labels(page, state)) == 9
    page.evaluate("window.same = true")
    page.select_option("select[name=object]", "2_box_b")
    page.select_option("select[name=sort]", "row")
    page.focus("select[name=order]")
    page.keyboard.press("ArrowDown")
    wait_for_labels(page, state, IN_ORDER)
    # The page was not loaded again, the keyboard stays where it was, and the number is told.
    assert page.evaluate("window.same") and page.evaluate("document.activeElement.name") == "order"
    page.wait_for_selector("#told:has-text('3 of 36 attempts')", state="attached")
    # The address has what was chosen, without empty fields.
    assert "object=2_box_b" in page.url and "removal" not in page.url

    # Back is as before.
    page.select_option("select[name=outcome]", "dropped")
    wait_for_cards(page, 1)
    page.go_back()
    wait_for_labels(page, state, IN_ORDER)
    page.click("text=Reset")
    wait_for_cards(page, 9)
    assert page.input_value("select[name=object]") == ""


def test_pages_fit_and_their_pictures_load(page: Page, address: str, state: Snapshot) -> None:
    for path in ("/", "/?outcome=any&sort=row&order=up", "/grasp/0-0-0"):
        for _ in in_each_size(page):
            page.goto(address + coded(state, path))
            if path.startswith("/grasp"):
                wait_for_view(page)


def test_3d_view_draws_each_state(page: Page, address: str, state: Snapshot) -> None:
    page.goto(coded(state, f"{address}/grasp/0-0-0"))
    wait_for_view(page)
    assert page.get_attribute("#view3d", "data-ready") == "yes"
    # A blank canvas has one colour; hand, object, table and contacts in light have many.
    assert colours_of(page) > 30
    shots = set()
    for state in ("start", "closed", "lifted"):
        page.click(f"[data-state={state}]")
        shots.add(page.locator("#view3d").screenshot())
    assert len(shots) == 3
    page.uncheck("[data-layer=hand]")
    assert page.locator("#view3d").screenshot() not in shots


def test_3d_view_shows_an_arm_that_is_asked_for(
    page: Page, address: str, out: Path, tmp_path: Path
) -> None:
    rows = reach_dataset(out, load_arm(write_arm(tmp_path), (-0.5, 0.0, 0.0, 0.0)))
    trial = rows.trial_id[rows.reachable][0]
    page.goto(f"{address}/grasp/{trial}")
    wait_for_view(page)
    view = page.locator("#view3d")
    shots = [view.screenshot()]
    for choose in (page.check, page.uncheck):  # the view moves back, and the arm goes
        choose("[data-layer='arm six']")
        wait_until(page, lambda: view.screenshot() not in shots)
        shots.append(view.screenshot())


def test_keys_move_the_3d_view(page: Page, address: str, state: Snapshot) -> None:
    page.goto(coded(state, f"{address}/grasp/0-0-0"))
    wait_for_view(page)
    first = page.locator("#view3d").screenshot()
    assert views(page, "Shift+ArrowLeft", "Shift+ArrowUp", "+", "h", "f", "3") == 7
    assert not page.is_checked("[data-layer=hand]")
    for key in ("h", "f", "2", "0"):
        page.keyboard.press(key)
    assert page.locator("#view3d").screenshot() == first
    # The list of keys; while it is open they do nothing.
    page.keyboard.press("?")
    assert "turn the 3D view" in page.inner_text("dialog#keys")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("h")
    page.keyboard.press("Escape")
    assert not page.is_visible("dialog#keys") and page.is_checked("[data-layer=hand]")
    page.keyboard.press("ArrowRight")
    page.wait_for_url(coded(state, "**/grasp/*"))


def test_keyboard_moves_rejects_and_undoes(
    page: Page, address: str, state: Snapshot, out: Path
) -> None:
    key = AttemptKey("1_box_a", 0, 0)
    page.goto(coded(state, f"{address}/grasp/0-0-0?sort=row&order=up"))
    page.keyboard.press("r")  # rejects, and goes on to the next
    page.wait_for_url(coded(state, "**/grasp/0-1-0?sort=row&order=up"))
    wait_for_decision(out, key, "rejected")
    page.keyboard.press("n")
    page.wait_for_url(coded(state, "**/grasp/0-3-2?sort=row&order=up"))
    page.keyboard.press("ArrowLeft")
    page.wait_for_url(coded(state, "**/grasp/0-1-0?sort=row&order=up"))
    page.keyboard.press("p")
    page.wait_for_url(coded(state, "**/grasp/0-0-0?sort=row&order=up"))
    assert page.inner_text("#decision") == "rejected"
    page.keyboard.press("ArrowRight")
    page.wait_for_url(coded(state, "**/grasp/0-1-0?sort=row&order=up"))

    # Undo shows what was undone.
    page.keyboard.press("u")
    wait_for_decision(out, key, "")
    page.wait_for_url(coded(state, "**/grasp/0-0-0?sort=row&order=up"))
    page.wait_for_selector("#decision", state="hidden")
    page.keyboard.press("u")
    page.wait_for_selector("#message:has-text('Nothing to undo.')")
    page.keyboard.press("g")
    page.wait_for_selector("#cards")


def test_a_server_that_has_ended_is_named(browser: Browser, out: Path, state: Snapshot) -> None:
    page = browser.new_page()
    with served(out) as address:
        page.goto(address)
    page.click(coded(state, "[data-label='0-0-0'] [data-decide=rejected]"))
    page.wait_for_selector("#message:not([hidden])", timeout=PATIENCE)
    assert "does not answer" in page.inner_text("#message")
    page.close()


def test_predictions_filter_and_open(page: Page, out: Path, tmp_path: Path) -> None:
    results = write_predictions(out, tmp_path / "run.h5")
    with served(out, results) as address:
        for _ in in_each_size(page):
            page.goto(f"{address}/predictions")
        page.select_option("select[name=verdict]", "fails")
        wait_for_cards(page, 2)
        page.click("#cards li:nth-child(2) a")
        wait_for_view(page)
        assert "2 of 2" in page.inner_text(".position")
        assert views(page, "a", "c", "t") == 4
        page.keyboard.press("g")
        page.wait_for_url("**/predictions?verdict=fails")


def open_second(page: Page, address: str, gallery: str) -> None:
    """Open a gallery and then the page of its second card, both of which must fit."""
    for _ in in_each_size(page):
        page.goto(address)
        page.click(f"text={gallery}")
    for _ in in_each_size(page):
        page.goto(address)
        page.click(f"text={gallery}")
        page.click("#cards li:nth-child(2) a")
        wait_for_view(page)
    assert page.get_attribute("#view3d", "data-ready") == "yes"


@pytest.mark.sim
def test_scenes_filter_and_open(page: Page, out: Path) -> None:
    make_scenes(out, overrides=["scenes.views=3"])
    with served(out) as address:
        open_second(page, address, "Scenes")
        assert "2 of 3" in page.inner_text(".position")
        # Palms, hands and the hand of another grasp are all drawn.
        assert views(page, "m", "2", "h", "m") == 5
        page.keyboard.press("g")
        page.wait_for_url("**/scenes")
        page.wait_for_load_state("networkidle")
        page.select_option("select[name=split]", "test")
        with h5py.File(out / "scenes.hdf5") as file:
            of_test = int(np.count_nonzero(file["scenes/split"][:] == SPLITS.index("test")))
        assert 0 < of_test < 3
        wait_for_cards(page, of_test)


#: The smallest contrast of a text to what is behind it, with that text. Disabled things and text in
#: pictures are not counted.
CONTRAST = """() => {
  const numbers = (text) => text.match(/[0-9.]+/g).map(Number);
  const linear = (x) => x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) =>
    0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const behind = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const colour = numbers(getComputedStyle(e).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  let worst = [99, ""];
  const judge = (element, text, part) => {
    const colour = numbers(getComputedStyle(element, part).color);
    const [a, b] = [light(colour), light(behind(element))].sort((x, y) => y - x);
    if ((a + 0.05) / (b + 0.05) < worst[0]) worst = [(a + 0.05) / (b + 0.05), text];
  };
  for (const element of document.querySelectorAll("body *")) {
    if (!element.checkVisibility() || element.closest("svg") || element.disabled) continue;
    const texts = [...element.childNodes].filter((node) => node.nodeType === 3);
    const own = texts.map((node) => node.textContent.trim()).join("");
    if (own || element.tagName === "SELECT") judge(element, own || element.name);
    if (element.placeholder) judge(element, element.placeholder, "::placeholder");
  }
  return worst;
}"""


@pytest.mark.sim
def test_scenes_of_several_objects_open(page: Page, out: Path) -> None:
    around = [load_surroundings("bin")]
    make_clutter(out, ClutterRequest(scenes=2, objects=(3, 3), surroundings=around, tries=1))
    with served(out) as address:
        open_second(page, address, "Clutter")
        # The best hand is shown first; neighbours and walls can be hidden.
        assert page.get_attribute("#view3d", "data-state") == page.inner_text("button[data-state]")
        assert views(page, "r", "o") == 3
        for theme in ("light", "dark"):
            page.select_option("#theme", theme)
            contrast, text = page.evaluate(CONTRAST)
            assert contrast >= 4.5, f"{theme}: {text!r} has {contrast:.2f}"
        page.keyboard.press("g")
        page.wait_for_url("**/clutter")
