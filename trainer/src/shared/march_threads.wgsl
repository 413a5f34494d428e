// march_shares: the part of a ray that one of several threads walks. After `march`.

const SHARES = 8u;

fn share_of_pieces(path: Path, share: u32) -> vec2u {
    let n = (path.n_pieces + SHARES - 1u) / SHARES;
    return min(vec2u(share, share + 1u) * n, vec2u(path.n_pieces));
}
