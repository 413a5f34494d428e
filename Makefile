# The same commands for developers and continuous integration; `make` without arguments lists them.
#
# As root, targets install missing dependencies (system packages with apt, pinned libraries and programs, the page's npm packages) and list
# them. Without root, they print the command that installs the system packages.

.DEFAULT_GOAL := help
.PHONY: help demo check-demo test quick test-gpu hil check docs fuzz deps web cargo packages test-packages check-packages mujoco realsense open-ends \
	begin-test checks lint lint-without-features doc kernels manifests licenses texts web-check linters test-build test-crates \
	test-program test-page test-hil
# Cargo and npm already use all processors, and two runs of apt would block each other.
.NOTPARALLEL:

# One feature set everywhere, so that dependencies compile once.
FEATURES := --features sim

# Tests also cover webcams through nokhwa, topics for Foxglove, and RealSense cameras if their library is available: see `realsense`.
TEST_FEATURES = $(FEATURES),nokhwa,foxglove$(shell [ -e .deps/realsense/made-of ] && \
	scripts/install-packages.sh --check realsense 2>/dev/null && echo ,realsense)

# The crates whose code depends on features, and one that makes them share dependencies with the others (tests/features).
CONDITIONAL := --package test-features --package fieldrig --package bench --package capture --package drivers --package trainer --package viz

# Folder of everything that cargo builds.
TARGET_FOLDER := $(or $(CARGO_TARGET_DIR),target)
# Runs a step and records how long it takes.
STEPS := $(TARGET_FOLDER)/steps.tsv
STEP := scripts/timed.sh $(STEPS)

# Rig that `make demo` simulates: name of a file in the folder rigs, without extension, or the path of a rig file.
RIG ?= static-arm
RIG_FILE = $(if $(filter %.toml,$(RIG)),$(RIG),rigs/$(RIG).toml)
# Port of the page of `make demo`. A variable of the environment does not count, because other programs use one with this name.
PORT = 7007
# Without a GPU, a run corrects the calibration only if that is requested, because it takes time from training. This rig shows it.
REFINE = $(if $(filter uncalibrated,$(RIG)),--refine auto)
# The arms of these rigs can be steered from the page.
MOTION = $(if $(filter static-arm static-arm-720p two-cameras uncalibrated mobile-arm mobile-base mobile-base-small,$(RIG)),--enable-motion)
# Duration of `make hil` in seconds.
LISTEN_SECONDS ?= 20

help: ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: check-demo deps web ## Simulate a rig (RIG=static-arm, mobile-arm, uncalibrated, ...) and serve the live scene at PORT=7007; needs no display
	cargo build --release $(FEATURES)
	$(TARGET_FOLDER)/release/fieldrig run $(RIG_FILE) --sim --listen 127.0.0.1:$(PORT) $(MOTION) $(REFINE)

check-demo:
	@scripts/check-demo.sh '$(RIG_FILE)' '$(PORT)'

RUN_TESTS = scripts/run-tests.py --steps $(STEPS) --report $(TARGET_FOLDER)/test-times.md
test: begin-test test-packages checks web ## Run lints, documentation and all tests that need no device
	@$(RUN_TESTS) -- --workspace $(TEST_FEATURES)

# The tests of `make test` in parts, which continuous integration runs on several machines. Each part builds its tests with the same features
# of all crates, so that they share one cache of dependencies.
test-build: begin-test test-packages deps realsense web

test-crates: test-build ## Run only the tests that are not in one of the three parts below
	@$(RUN_TESTS) --only '^(?!fieldrig (program|hil)$$|viz viewer$$)' -- --workspace $(TEST_FEATURES)

test-program: test-build ## Run only the tests of the whole program
	@$(RUN_TESTS) --no-doc -- --workspace --test program $(TEST_FEATURES)

test-page: test-build ## Run only the tests of the server and the page
	@$(RUN_TESTS) --no-doc -- --workspace --test viewer $(TEST_FEATURES)

test-hil: test-build ## Run only the tests in virtual machines
	@$(RUN_TESTS) --no-doc -- --workspace --test hil $(TEST_FEATURES)

quick: begin-test lint texts web-check ## Run lints and the tests that need neither a GPU nor a browser
	@scripts/run-tests.py --steps $(STEPS) --no-doc --quick -- --workspace --lib --bins $(TEST_FEATURES)

test-gpu: deps ## Run the tests that need a real GPU
	FIELDRIG_GPU_TESTS=demand scripts/run-tests.py --no-doc --only "^(gpu|trainer) unit" --filter needs_ -- \
		--package gpu --package trainer --lib

# Forgets the durations of earlier steps.
begin-test:
	@rm -f $(STEPS)

hil: cargo packages web ## Check the devices of the rig RIG=file.toml: reads all of them for LISTEN_SECONDS=20 and moves nothing
	cargo build --release $(shell pkg-config --exists realsense2 2>/dev/null && echo --features realsense)
	$(TARGET_FOLDER)/release/fieldrig doctor $(if $(filter file,$(origin RIG)),$(error RIG is not set; run: make hil RIG=file.toml),$(RIG)) --listen $(LISTEN_SECONDS)

check: checks kernels ## Check format, clippy, documentation, kernels, spelling, licenses, the source of the page

# What `make test` checks beside its tests.
checks: texts lint lint-without-features doc manifests licenses web-check

lint: check-packages deps realsense open-ends
	@$(STEP) format cargo fmt --all --check
	@$(STEP) clippy cargo clippy --workspace --all-targets $(TEST_FEATURES) -- -D warnings

lint-without-features: lint
	@$(STEP) "clippy without features" cargo clippy $(CONDITIONAL) --all-targets --no-default-features --no-deps -- -D warnings

doc: lint
	@RUSTDOCFLAGS="-D warnings" $(STEP) documentation cargo doc --workspace --no-deps $(TEST_FEATURES)

docs: deps realsense web ## Rewrite docs/reference/cli.md and the table of keys from the source
	FIELDRIG_WRITE_DOCS=1 cargo test --package fieldrig --bin fieldrig $(TEST_FEATURES) -- cli_page
	scripts/install-web.sh check && cd viz/web && FIELDRIG_WRITE_DOCS=1 npm run --silent test -- key_page

kernels: deps realsense
	cargo test --workspace $(TEST_FEATURES) --lib every_kernel_is_valid

manifests: cargo
	@cargo metadata --locked --manifest-path fuzz/Cargo.toml --format-version 1 >/dev/null || { echo "fuzz/Cargo.lock does not match fuzz/Cargo.toml; to update it, run: cargo metadata --manifest-path fuzz/Cargo.toml" >&2; exit 1; }

licenses: cargo
	@if python3 -c 'import tomllib' 2>/dev/null; then scripts/licenses.py --check; \
	else echo "list of licenses: skipped, because Python is older than 3.11"; fi
	@if cargo deny --version >/dev/null 2>&1; then \
		cargo deny check licenses bans sources || exit 1; \
		if cargo deny fetch db >/dev/null 2>&1; then cargo deny check advisories; \
		else echo "cargo deny: advisories skipped, because their database is unreachable"; fi; \
	else echo "cargo deny: skipped, because it is not installed (cargo install --locked cargo-deny)"; fi

texts: linters
	@$(STEP) "spelling, TOML" scripts/check-texts.sh

web-check: packages ## Lint the source of the page, and run its unit tests
	@$(STEP) "lint and unit tests of the page" scripts/check-web.sh

# Duration per fuzz target in seconds.
SECONDS ?= 600
fuzz: cargo ## Fuzz all parsers, SECONDS=600 each, or only TARGET=can (scripts/fuzz.sh)
	scripts/fuzz.sh $(SECONDS) $(TARGET)

deps: cargo packages mujoco ## Install build and test dependencies

web: cargo packages ## Build the web page that the binary embeds
	@$(STEP) "web page" scripts/build-web.sh

cargo:
	@scripts/check-cargo.sh

packages:
	@scripts/install-packages.sh build gpu sim web

# One call checks all groups, so that users without root get a single command to run. Tests whose packages cannot be installed are skipped
# with a message, unless FIELDRIG_HIL=demand.
OPTIONAL = $(if $(filter demand,$(FIELDRIG_HIL)),,--optional)
test-packages: cargo
	@$(STEP) packages scripts/install-packages.sh build gpu sim web nokhwa $(OPTIONAL) realsense browser hil
	@scripts/fetch-qemu.sh || [ "$$FIELDRIG_HIL" != demand ]

check-packages: cargo
	@scripts/install-packages.sh build gpu sim web nokhwa $(OPTIONAL) realsense

mujoco: packages
	@scripts/fetch-mujoco.sh

linters: cargo packages
	@scripts/fetch-linters.sh

# Without the library, tests of RealSense cameras are skipped with a message, unless FIELDRIG_HIL=demand.
realsense: check-packages
	@scripts/install-packages.sh --check realsense && scripts/fetch-realsense.sh || { [ "$$FIELDRIG_HIL" != demand ] && \
	echo "skipped: tests of RealSense cameras"; }

open-ends:
	@scripts/check-open-ends.sh
