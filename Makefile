# The same commands by hand and in continuous integration; `make` alone lists them.
#
# Every target installs what it misses (system packages with apt when run as root, the pinned MuJoCo library,
# the page's npm packages) and says so; without root it prints the one line to run.

.DEFAULT_GOAL := help
.PHONY: help demo test check deps web cargo mujoco packages-build packages-gpu packages-sim packages-web bless

# One feature set everywhere, so that dependencies compile once.
FEATURES := --features sim

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: packages-build packages-gpu mujoco web ## Simulate the static arm and serve the growing scene; needs no display
	cargo build --release $(FEATURES)
	cargo run --quiet --release $(FEATURES) -- run rigs/static-arm.toml --sim

test: check ## Lints, documentation and every test that needs no device
	cargo test --workspace $(FEATURES) --no-fail-fast

check: deps ## Format, clippy, documentation, licences, open ends
	cargo fmt --all --check
	cargo clippy --workspace --all-targets $(FEATURES) -- -D warnings
	cargo clippy --workspace --exclude sim --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps $(FEATURES)
	@scripts/check-open-ends.sh
	@if cargo deny --version >/dev/null 2>&1; then cargo deny check; \
	else echo "cargo deny: skipped, not installed (cargo install --locked cargo-deny)"; fi

deps: packages-build packages-gpu mujoco ## What building and testing need: system packages and the MuJoCo library

web: packages-web ## Build the web page that the binary embeds
	scripts/build-web.sh

cargo:
	@command -v cargo >/dev/null 2>&1 || { echo "cargo is missing; run this line, then try again:" >&2; \
	echo "    curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh" >&2; exit 1; }

mujoco: packages-sim
	@scripts/fetch-mujoco.sh

packages-build: cargo
	@scripts/install-packages.sh build

packages-gpu:
	@scripts/install-packages.sh gpu

packages-sim:
	@scripts/install-packages.sh sim

packages-web:
	@scripts/install-packages.sh web
