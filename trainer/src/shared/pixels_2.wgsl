// pixels: 2 neighbors in a row, processed together by one lane.

alias Px = vec2f;
alias PxU = vec2u;
alias PxB = vec2<bool>;
const PX = 2u;
const RAMP = Px(0.0, 1.0);
const INDEX = PxU(0u, 1u);
