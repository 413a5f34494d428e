// march_threads: splits a ray among several threads. Import after `march`.

const THREADS_PER_RAY = 8u;

fn segments_of_thread(path: Path, share: u32) -> vec2u {
    let n = (path.n_segments + THREADS_PER_RAY - 1u) / THREADS_PER_RAY;
    return min(vec2u(share, share + 1u) * n, vec2u(path.n_segments));
}
