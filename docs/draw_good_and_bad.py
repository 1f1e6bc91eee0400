"""Draw docs/images/good_and_bad.png, the picture of docs/your_own_arm.md: three payloads over time.

Use: ``python docs/draw_good_and_bad.py``. The arm is the one of the page. The first recording is that of the page (40
dB); the others have sensors of 1e-5 rad and m, whose noise does not shrink with the motion.
"""

from __future__ import annotations

import csv
import math
import re
import tempfile
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from flexmanip_ros.cli import identify_bag, simulate_bag

DOCS = Path(__file__).resolve().parent
TRUE_MASS = 0.3
STRONG, WEAK = '[0.3, 0.1]', '[0.0003, 0.0001]'
"""Peak torques [N m]."""
PANELS = (('good', STRONG, []), ('tip mass 0.1 kg too large in the file', STRONG, ['arm.tip_mass=0.3']),
          ('a thousandth of the torque', WEAK, []))
TRACKED, DOUBTED, TRUTH = '#009E73', '#D55E00', '#000000'


def estimates(folder: Path, name: str, torque: str, settings: list[str]) -> list[dict[str, str]]:
    """Simulate and identify one recording; return the rows of its table from the capture on."""
    page = (DOCS / 'your_own_arm.md').read_text(encoding='utf-8')
    arm = folder / 'my_arm.yaml'
    arm.write_text(re.findall(r'^```yaml\n(.*?)^```', page, re.MULTILINE | re.DOTALL)[0], encoding='utf-8')
    bag, table = str(folder / name), str(folder / f'{name}.csv')
    noise = 'std' if settings or torque == WEAK else 'snr'
    simulate_bag.main([bag, '--params', str(arm), '--payload', str(TRUE_MASS), '--set', f'noise={noise}',
                       '--set', f'excitation.amplitude={torque}'])
    chosen = [part for item in settings for part in ('--set', item)]
    identify_bag.main([bag, '--params', str(arm), '--output', table, *chosen])
    with Path(table).open(encoding='utf-8') as lines:
        return [row for row in csv.DictReader(lines) if float(row['time_s']) > 3.0]


def main() -> None:
    """Draw."""
    figure = Figure(figsize=(10.0, 3.2), dpi=110, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    with tempfile.TemporaryDirectory() as folder:
        for number, (ax, (title, torque, settings)) in enumerate(zip(axes, PANELS, strict=True)):
            rows = estimates(Path(folder), f'panel{number}', torque, settings)
            time = [float(row['time_s']) for row in rows]
            mass, lower, upper = ([float(row[f'payload_{key}_kg'] or 'nan') for row in rows]
                                  for key in ('mass', 'lower', 'upper'))
            trusted = [row['status'] == 'TRACKING' for row in rows]
            for state, colour, label in ((True, TRACKED, 'TRACKING'), (False, DOUBTED, 'any other status')):
                shown = [one == state for one in trusted]
                ax.fill_between(time, [min(one, 9.0) for one in lower], [min(one, 9.0) for one in upper], where=shown,
                                color=colour, alpha=0.3, linewidth=0.0, label=f'95 % band, {label}')
                ax.plot(time, [one if here else math.nan for one, here in zip(mass, shown, strict=True)], color=colour)
            ax.axhline(TRUE_MASS, color=TRUTH, linestyle=':', label='true mass')
            ax.set_title(title, fontsize=10)
            ax.set_xlabel('time [s]')
    axes[0].set_ylabel('payload [kg]')
    axes[0].set(xlim=(3.0, 6.0), ylim=(0.0, 0.8))
    axes[0].legend(fontsize=8, loc='upper right')
    figure.savefig(DOCS / 'images/good_and_bad.png')


if __name__ == '__main__':
    main()
