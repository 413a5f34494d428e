// Runs before the scripts of the page: a headset, its controllers, and functions for tests. IWER was loaded before.
const device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true, visibilityMask: null });
// Without `forceInstall`, IWER leaves the API of the browser in place, which has no headset.
device.installRuntime({ forceInstall: true });
device.position.set(0, 1.6, 0);
window.device = device;

const sub = (a, b) => a.map((value, ix) => value - b[ix]);
const dot = (a, b) => a.reduce((sum, value, ix) => sum + value * b[ix], 0);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** The shortest rotation from one direction to another one, as x, y, z, w. */
function rotation(from, to) {
  const [a, b] = [unit(from), unit(to)];
  const q = [...cross(a, b), 1 + dot(a, b)];
  return q.map((value) => value / Math.hypot(...q));
}

/** Puts a controller somewhere, with one of its axes toward a point. */
window.put = (side, at, axis, toward) => {
  const controller = device.controllers[side];
  controller.position.set(...at);
  controller.quaternion.set(...rotation(axis, sub(toward, at)));
};

/** Holds the left palm toward the head, so that the menu appears. */
window.showPalm = () => put("left", [-0.1, 1.3, -0.45], [1, 0, 0], [0, 1.6, 0]);
window.hidePalm = () => put("left", [-0.3, 1.0, -0.3], [0, 0, -1], [-0.3, 1.0, -2]);

/** Points at a button of the menu; returns whether it is there. */
window.aimAt = (label) => {
  const button = fieldrigHeadset().menu?.buttons.find((other) => other.label === label);
  if (button) put("right", [0.2, 1.25, -0.1], [0, 0, -1], button.at);
  return button !== undefined;
};
window.isOn = (label) => fieldrigHeadset().menu?.buttons.find((other) => other.label === label)?.isOn;
window.hold = (side, button, value) => device.controllers[side].updateButtonValue(button, value);
