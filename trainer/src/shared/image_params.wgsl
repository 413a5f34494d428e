// image_terms: what is learned about an image. Its pose: how it is turned about where its rays begin, rotation vector in world, radians;
// how it is shifted in world, in units of the scene's radius. Its code: light and exposure, as the network of colors takes them. A term is
// its value, Adam's two means, and the steps it took.

const IMAGE_PARAM_STRIDE = 9u;    // of an image
const TRANSLATION = 3u;          // the first of the shift
const EMBEDDING = 6u;           // the first of the code, which has three numbers at most
