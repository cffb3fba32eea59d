"""The live view in headless Chromium: it opens without network, and shows what is going on."""

import pytest
from chromium import BROWSER_OPTIONS
from conftest import wait
from dashboard_world import SENSORS, PretendedChain, browser_path


@pytest.fixture
def page(ros, start, tmp_path):
    """An open page of a live view, and the chain that it shows."""
    executable = browser_path()
    from playwright.sync_api import sync_playwright

    dashboard = start(
        'dashboard', '--ros-args', '-p', 'port:=0', '-p', f'directory:={tmp_path / "bags"}'
    )
    chain = PretendedChain(ros)
    dashboard.wait_for('live view: ')
    address = dashboard.output.split('live view: ')[1].split()[0]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=BROWSER_OPTIONS)
        opened = browser.new_page(viewport={'width': 1280, 'height': 800})
        opened.asked, opened.errors = [], []
        opened.on('request', lambda request: opened.asked.append(request.url))
        opened.on('pageerror', lambda error: opened.errors.append(str(error)))
        opened.goto(address)
        yield opened, chain, address
        browser.close()
    chain.end()
    assert dashboard.interrupt() == 0


def test_it_opens_offline_and_shows_ten_sensors(page):
    opened, chain, address = page
    instrument = opened.locator('.instrument')
    opened.wait_for_selector(f'.instrument[data-poses="{SENSORS + 1}"]', timeout=60_000)
    begin = int(instrument.get_attribute('data-frames'))
    assert wait(lambda: int(instrument.get_attribute('data-frames')) > begin + 10)
    own = tuple(prefix + address.split('/')[2] for prefix in ('http://', 'ws://'))
    foreign = [url for url in opened.asked if not url.startswith((*own, 'data:', 'blob:'))]
    assert not foreign
    assert not opened.errors

    rows = opened.locator('.states tbody tr')
    assert rows.count() == SENSORS + 1
    bad, good = (rows.nth(n).locator('td').all_text_contents() for n in (0, 1))
    assert bad[:2] == ['pen/c0', 'residual4.2 times'], 'a state that is not ok, with its reason'
    assert good[:2] == ['pen/c1', 'ok']
    assert float(good[4]) == pytest.approx(162.0, abs=0.06), 'z, mm'
    assert float(good[5]) == pytest.approx(0.24, abs=0.01), 'sigma, mm'
    assert float(good[6]) == pytest.approx(2.0, abs=0.05), 'error to the optical pose, mm'
    assert float(good[7]) == pytest.approx(90.0, abs=0.6), 'residual, pT'
    assert float(good[8]) > 0.0, 'poses a second'
    assert 'something <b>new</b>' in opened.locator('.loop').inner_text(), 'as text, not as HTML'

    opened.get_by_role('button', name='Record').click()
    opened.get_by_text('the disk is full').wait_for(timeout=60_000)
    assert chain.calls == ['recorder/start']
    assert opened.get_by_role('button', name='Load corrected model').is_disabled()
