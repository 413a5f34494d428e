// image_params: parameters optimized per image.
//
// The pose consists of a rotation and a translation. The rotation is about the origins of the image's rays, as a
// rotation vector in world, radians. The translation is in world, in units of the scene radius. The appearance
// embedding is an input of the color network that represents lighting and exposure. Each parameter has its value,
// Adam's two moments, and the number of steps taken.

const IMAGE_PARAM_STRIDE = 9u;    // parameters per image
const TRANSLATION = 3u;          // index of the first translation parameter
const EMBEDDING = 6u;           // index of the first of up to three embedding parameters
