// A WebGL context that accepts every call and draws nothing.
const real = WebGL2RenderingContext;
HTMLCanvasElement.prototype.getContext = new Proxy(HTMLCanvasElement.prototype.getContext, {
  apply(original, canvas, args) {
    if (args[0] !== 'webgl2') return Reflect.apply(original, canvas, args);
    const answers = {
      canvas, drawingBufferWidth: 1280, drawingBufferHeight: 720, drawingBufferColorSpace: 'srgb',
      getParameter: (name) => name === real.VERSION ? 'WebGL 2.0'
        : name === real.SHADING_LANGUAGE_VERSION ? 'WebGL GLSL ES 3.00'
        : name === real.SCISSOR_BOX || name === real.VIEWPORT ? new Int32Array([0, 0, 1280, 720]) : 4096,
      getShaderPrecisionFormat: () => ({ rangeMin: 127, rangeMax: 127, precision: 23 }),
      getContextAttributes: () => ({ alpha: true, antialias: true, depth: true }),
      getSupportedExtensions: () => [],
      getExtension: () => null,
      isContextLost: () => false,
      getProgramParameter: (_, name) => name === real.LINK_STATUS ? true : 0,
      getShaderParameter: () => true,
      getProgramInfoLog: () => '',
      getShaderInfoLog: () => '',
      getError: () => 0,
      checkFramebufferStatus: () => real.FRAMEBUFFER_COMPLETE,
    };
    canvas.context ??= new Proxy(answers, {
      get: (_, name) => name in answers ? answers[name]
        : name in real ? real[name]
        : String(name).startsWith('create') ? () => ({})
        : () => undefined,
    });
    return canvas.context;
  },
});
