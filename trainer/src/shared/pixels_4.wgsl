// pixels: 4 neighbors in a row, processed together by one lane.

alias Px = vec4f;
alias PxU = vec4u;
alias PxB = vec4<bool>;
const PX = 4u;
const RAMP = Px(0.0, 1.0, 2.0, 3.0);
const INDEX = PxU(0u, 1u, 2u, 3u);
