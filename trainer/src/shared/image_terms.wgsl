// image_terms: what is wrong about an image's pose: how it is turned about where its rays begin, rotation vector in world, radians;
// how it is shifted in world, in units of the scene's radius. A term is its value, Adam's two means, and the steps it took.

const TERMS = 6u;          // of an image
const TERM_STRIDE = 8u;
const SHIFT = 3u;          // the first of the shift
