// The layers of a real headset, which IWER does not have: a projection layer whose eyes share one texture. After each frame,
// the texture is copied to a canvas over the page.
const sessions = new WeakMap();

class StubBinding {
  constructor(session, gl) {
    this.session = session;
    this.gl = gl;
  }

  createProjectionLayer({ colorFormat, depthFormat, scaleFactor }) {
    const { gl, session } = this;
    const base = new XRWebGLLayer(session, gl); // IWER draws no frames without one.
    session.updateRenderState({ baseLayer: base });
    const [width, height] = [window.innerWidth, window.innerHeight].map((side) => Math.round(side * scaleFactor));
    const texture = (format) => {
      const made = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, made);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.bindTexture(gl.TEXTURE_2D, null);
      return made;
    };
    const layer = {
      textureWidth: width,
      textureHeight: height,
      ignoreDepthValues: true,
      fixedFoveation: 0,
      color: texture(colorFormat),
      depth: texture(depthFormat),
      read: gl.createFramebuffer(),
    };
    sessions.set(session, { gl, layer });
    session.addEventListener("end", () => shown.remove());
    window.nProjectionLayers = (window.nProjectionLayers ?? 0) + 1;
    return layer;
  }

  getViewSubImage(layer, view) {
    const width = layer.textureWidth / 2;
    const x = view.eye === "right" ? width : 0;
    return {
      colorTexture: layer.color,
      depthStencilTexture: layer.depth,
      viewport: { x, y: 0, width, height: layer.textureHeight },
    };
  }
}
window.XRWebGLBinding = StubBinding;

const shown = document.createElement("canvas");
shown.style.cssText = "position: fixed; inset: 0; width: 100%; height: 100%; z-index: 1000; pointer-events: none";

/** Copies the pixels without drawing, because three.js keeps the state of WebGL. */
function copyToCanvas({ gl, layer }) {
  const { textureWidth: width, textureHeight: height } = layer;
  if (!shown.isConnected) document.body.append(shown);
  [shown.width, shown.height] = [width, height];
  const before = gl.getParameter(gl.READ_FRAMEBUFFER_BINDING);
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, layer.read);
  gl.framebufferTexture2D(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, layer.color, 0);
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, before);
  const image = new ImageData(width, height);
  // Textures of WebGL begin at the bottom.
  for (let y = 0; y < height; y++) image.data.set(pixels.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
  shown.getContext("2d").putImageData(image, 0, 0);
}

const { requestAnimationFrame: requestFrame, updateRenderState } = XRSession.prototype;
XRSession.prototype.requestAnimationFrame = function (callback) {
  return requestFrame.call(this, (time, frame) => {
    callback(time, frame);
    const drawn = sessions.get(this);
    if (drawn) copyToCanvas(drawn);
  });
};
XRSession.prototype.updateRenderState = function ({ layers, ...state }) {
  return updateRenderState.call(this, state);
};
