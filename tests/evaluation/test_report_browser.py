"""The page in a browser: it opens whole, without a network, and its charts can be used. Pictures are kept in out/screenshots."""

import time
from itertools import count

import polars as pl
import pytest

from factorgraph_loc.evaluation.report import write_report
from factorgraph_loc.evaluation.report.tracks import KINDS

BAD = '</script><script>window.hacked = 1</script><img src=x onerror="window.hacked = 1">'
LOGS = ["hall", "office, second floor", "yard"]


@pytest.fixture(scope="module")
def page(made, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    runs = made({"ekf": 0.1, "smoother": 0.07, "dead_reckoning": 0.6}, LOGS, 2, count=600)
    write_report(runs.rows, runs.runs, path, baseline="ekf", title="Three estimators")
    return path


def centre(chromium, selector):
    """The middle of an element, scrolled into view."""
    return chromium.run(
        f"""(() => {{
            const found = document.querySelector({selector!r});
            found.scrollIntoView({{block: "center", behavior: "instant"}});
            const r = found.getBoundingClientRect();
            return [r.left + r.width / 2, r.top + r.height / 2];
        }})()"""
    )


def transform(chromium):
    return chromium.run("document.querySelector('.plan > g').getAttribute('transform')")


@pytest.mark.parametrize(
    ("name", "window"),
    [("light", {}), ("dark", {"dark": True}), ("phone", {"width": 390, "height": 844, "phone": True})],
)
def test_opens_whole(chromium, page, pictures, name, window):
    chromium.open(page, **window)
    assert chromium.run("document.documentElement.dataset.ready") == "yes"
    assert chromium.problems == []
    assert chromium.requests() == []
    assert chromium.run("document.documentElement.scrollWidth <= window.innerWidth")
    assert chromium.run("[...document.querySelectorAll('.chart, .map, .strips')].every((c) => c.querySelector('svg'))")
    light = sum(chromium.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)"))
    assert (light < 150) == (name == "dark")
    chromium.screenshot(pictures / f"report-{name}.png", whole=True)
    assert (pictures / f"report-{name}.png").stat().st_size > 30_000


def test_letters_can_be_read_in_light_and_dark(chromium, page):
    """Contrast of text with its background of at least 4.5 (WCAG 2.1, 1.4.3), but of what is grey as it says little."""
    ratios = """[...document.querySelectorAll('p, td b, td small, th, figcaption, summary, a, h2')].filter(
        (e) => !e.closest('.grey') && e.textContent).map((e) => {
        const light = (c) => { const v = c.match(/[\\d.]+/g).slice(0, 3).map((x) => x / 255)
            .map((x) => (x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
            return 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2]; };
        const pair = [light(getComputedStyle(e).color), light(getComputedStyle(document.body).backgroundColor)].sort();
        return (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05); })"""
    for dark in (False, True):
        chromium.open(page, dark=dark)
        found = chromium.run(ratios)
        assert len(found) > 50
        assert min(found) >= 4.5


def test_strings_of_a_log_do_not_run(chromium, made, tmp_path):
    bad = made({BAD: 0.1, "ekf": 0.2}, [BAD, "good"], count=60)
    failed = pl.col("key") == "0003"
    bad.rows = bad.rows.with_columns(
        status=pl.when(failed).then(pl.lit("failed")).otherwise("status"), reason=pl.lit(BAD)
    )
    bad.config = f"# {BAD}\n[versions]\n".encode()
    write_report(bad.rows, bad.runs, tmp_path / "bad.html", title=BAD, baseline=BAD, experiment={"name": BAD})
    chromium.open(tmp_path / "bad.html")
    chromium.mouse("mouseMoved", *centre(chromium, ".map svg"))
    chromium.run("document.querySelectorAll('select').forEach((s) => s.dispatchEvent(new Event('change')))")
    assert chromium.run("[document.documentElement.dataset.ready, typeof window.hacked, document.images.length]") == [
        "yes",
        "undefined",
        0,
    ]
    assert chromium.run("document.querySelector('h1').textContent") == BAD
    assert chromium.requests() == []


def test_policy_stops_what_slips_through(chromium, page, tmp_path):
    changed = page.read_text(encoding="utf-8").replace("<main>", f"<main><p>{BAD.removeprefix('</script>')}</p>")
    (tmp_path / "changed.html").write_text(changed, encoding="utf-8")
    chromium.open(tmp_path / "changed.html")
    assert chromium.run("[document.documentElement.dataset.ready, typeof window.hacked]") == ["yes", "undefined"]
    assert any("Content Security Policy" in str(problem) for problem in chromium.problems)


def test_map_zooms_moves_and_tells(chromium, page, pictures):
    chromium.open(page)
    x, y = centre(chromium, ".plan")
    before = transform(chromium)
    chromium.mouse("mouseWheel", x, y, deltaX=0, deltaY=-100)
    assert transform(chromium) == before  # the page scrolls until the map is clicked
    x, y = centre(chromium, ".plan")
    for kind in ("mousePressed", "mouseReleased"):
        chromium.mouse(kind, x, y, button="left", clickCount=1)
    chromium.mouse("mouseWheel", x, y, deltaX=0, deltaY=-100)
    near = transform(chromium)
    scales = [float(t.split("(")[1].split(")")[0]) for t in (before, near)]
    assert scales[1] > 1.1 * scales[0]
    chromium.mouse("mousePressed", x, y, button="left", clickCount=1)
    chromium.mouse("mouseMoved", x + 60, y, button="left", buttons=1)
    chromium.mouse("mouseReleased", x + 60, y, button="left", clickCount=1)
    assert transform(chromium) != near
    chromium.run("document.querySelector('[data-reset]').click()")
    assert transform(chromium) == before
    at = chromium.run(
        """(() => { const line = document.querySelector('.plan .c1 .line'), m = line.getScreenCTM();
            const p = line.getPointAtLength(line.getTotalLength() / 2).matrixTransform(m); return [p.x, p.y]; })()"""
    )
    chromium.mouse("mouseMoved", *at)
    told = chromium.run("document.querySelector('.tip').innerText")
    assert told.split("\n")[0] in ("ekf", "smoother", "dead_reckoning")
    assert "error" in told
    assert "2σ" in told
    assert chromium.run("document.querySelectorAll('.plan .cursor').length") == 3
    chromium.screenshot(pictures / "report-hover.png")


def test_legend_hides_and_shows(chromium, page):
    chromium.open(page)
    lines = "document.querySelectorAll('.plan .line').length"
    strips = "document.querySelectorAll('.strips svg').length"
    assert (chromium.run(lines), chromium.run(strips)) == (3, 3)
    chromium.run("document.querySelector('.legend .chip').click()")
    assert (chromium.run(lines), chromium.run(strips)) == (2, 2)
    assert chromium.run("[...document.querySelectorAll('.chip[aria-pressed=false]')].length") == 2  # both legends
    chromium.run(
        "document.querySelectorAll('.chip').forEach((c) => c.getAttribute('aria-pressed') === 'true' && c.click())"
    )
    assert chromium.run(lines) == 0
    assert chromium.problems == []


def test_choices_of_log_kind_and_metric(chromium, page):
    chromium.open(page)
    line = "document.querySelector('.plan .c0 .line').getAttribute('d')"
    met = {chromium.run(line)}
    chromium.run(
        "[...document.querySelectorAll('#trajectories button')].find((b) => b.textContent === 'final').click()"
    )
    met.add(chromium.run(line))
    choose = "const s = document.querySelector('{} select'); s.value = {}; s.dispatchEvent(new Event('change'))"
    chromium.run(f"(() => {{ {choose.format('#trajectories', 1)} }})()")
    met.add(chromium.run(line))
    assert len(met) == 3
    shown = (
        "[...document.querySelectorAll('#by-log [data-metric]')].filter((t) => !t.hidden).map((t) => t.dataset.metric)"
    )
    assert chromium.run(shown) == ["causal position RMSE [m]"]
    chromium.run(f"(() => {{ {choose.format('#by-log', 1)} }})()")
    assert chromium.run(shown) == ["final position RMSE [m]"]
    curve = "document.querySelector('#distributions .line').getAttribute('d')"
    before = chromium.run(curve)
    chromium.run(f"(() => {{ {choose.format('#distributions', 2)} }})()")
    assert chromium.run(curve) != before
    assert chromium.problems == []


def test_a_stretch_of_time_is_looked_at(chromium, page):
    chromium.open(page)
    x, y = centre(chromium, ".strips svg")
    texts = "[...document.querySelectorAll('.strips svg:last-child text')].map((t) => t.textContent)"
    ticks = f"{texts}.filter((t) => /^\\d+$/.test(t))"
    before = chromium.run(ticks)
    chromium.mouse("mousePressed", x, y, button="left", clickCount=1)
    chromium.mouse("mouseMoved", x + 120, y, button="left", buttons=1)
    chromium.mouse("mouseReleased", x + 120, y, button="left", clickCount=1)
    assert chromium.run(ticks) != before
    assert chromium.run("document.querySelectorAll('.plan .away').length") == 3
    chromium.run("document.querySelector('[data-reset]').click()")
    assert chromium.run(ticks) == before
    assert chromium.problems == []


def test_a_thousand_runs(chromium, made, tmp_path):
    """1,000 runs of 10 minutes: at most 20 s, at most 10 MB, opens within 2 s (the best of three, as others use the machine)."""
    few = made({f"estimator {i}": 0.1 + 0.02 * i for i in range(10)}, ["one", "two"], count=6000)
    keys = count()
    copies = [
        row | {"log": f"log {i}", "seed": seed, "key": f"{next(keys)} {row['key']}"}
        for i in range(25)
        for seed in range(2)
        for row in few.rows.iter_rows(named=True)
        if (row["log"] == "one") == (i % 2 == 0)
    ]
    rows = pl.DataFrame(copies * 2).with_columns(seed=pl.Series([r["seed"] + 2 * k for k in range(2) for r in copies]))
    assert len(rows) == 1000
    page = tmp_path / "report.html"
    began = time.process_time()
    write_report(rows, lambda key: few.runs(key.split()[1]), page)
    assert time.process_time() - began < 20.0
    assert page.stat().st_size < 10e6
    opened = []
    for _ in range(3):
        began = time.perf_counter()
        chromium.open(page)
        opened.append(time.perf_counter() - began)
        assert chromium.run("document.documentElement.dataset.ready") == "yes"
    assert min(opened) < 2.0
    for kind in KINDS:
        assert chromium.run(f"document.querySelectorAll('[data-kind={kind}] .line').length") == 8
