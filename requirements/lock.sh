#!/bin/sh
# lock.sh: write the *.txt locks (every version and hash, for Python 3.11 to 3.13) from the *.in lists.
set -eu
cd "$(dirname "$0")/.."
# colcon asks for what measures the coverage of tests. Nothing here does, and numba imports it in every process (0.07 s).
compile() {
    oldest=$1
    shift
    UV_PYTHON_DOWNLOADS=never uv pip compile --quiet --universal --python-version "$oldest" --fork-strategy fewest \
        --generate-hashes --no-strip-extras --no-annotate --no-emit-index-url \
        --no-emit-package coverage --no-emit-package pytest-cov \
        --custom-compile-command requirements/lock.sh "$@"
}
compile 3.11 requirements/runtime.in --output-file requirements/runtime.txt
compile 3.11 requirements/development.in --constraints requirements/runtime.txt --output-file requirements/development.txt
compile 3.11 requirements/benchmark.in --constraints requirements/development.txt --output-file requirements/benchmark.txt
# In environments of their own: the page builder, and the versions of Ubuntu 24.04.
compile 3.11 requirements/docs.in --output-file requirements/docs.txt
compile 3.12 requirements/jazzy.in --output-file requirements/jazzy.txt
