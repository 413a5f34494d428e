// sh: real spherical harmonics up to degree 3, in the order and with the signs of Kerbl et al. 2023.
//
// twin      splat/reference/sh.rs

const SH_0 = 0.28209479177387814;
const SH_1 = 0.4886025119029199;

// Basis functions 1 to 15 at a unit direction; those past the degree are 0.
fn sh_basis(direction: vec3f, degree: u32) -> array<f32, 15> {
    var y: array<f32, 15>;
    let d = direction;
    if degree >= 1u {
        y[0] = -SH_1 * d.y;
        y[1] = SH_1 * d.z;
        y[2] = -SH_1 * d.x;
    }
    if degree >= 2u {
        y[3] = 1.0925484305920792 * d.x * d.y;
        y[4] = -1.0925484305920792 * d.y * d.z;
        y[5] = 0.31539156525252005 * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y);
        y[6] = -1.0925484305920792 * d.x * d.z;
        y[7] = 0.5462742152960396 * (d.x * d.x - d.y * d.y);
    }
    if degree >= 3u {
        y[8] = -0.5900435899266435 * d.y * (3.0 * d.x * d.x - d.y * d.y);
        y[9] = 2.890611442640554 * d.x * d.y * d.z;
        y[10] = -0.4570457994644658 * d.y * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y);
        y[11] = 0.3731763325901154 * d.z * (2.0 * d.z * d.z - 3.0 * d.x * d.x - 3.0 * d.y * d.y);
        y[12] = -0.4570457994644658 * d.x * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y);
        y[13] = 1.445305721320277 * d.z * (d.x * d.x - d.y * d.y);
        y[14] = -0.5900435899266435 * d.x * (d.x * d.x - 3.0 * d.y * d.y);
    }
    return y;
}

// Gradients of the basis functions with respect to the direction, as if its components were free.
fn sh_basis_gradient(direction: vec3f, degree: u32) -> array<vec3f, 15> {
    var g: array<vec3f, 15>;
    let d = direction;
    if degree >= 1u {
        g[0] = vec3f(0.0, -SH_1, 0.0);
        g[1] = vec3f(0.0, 0.0, SH_1);
        g[2] = vec3f(-SH_1, 0.0, 0.0);
    }
    if degree >= 2u {
        g[3] = 1.0925484305920792 * vec3f(d.y, d.x, 0.0);
        g[4] = -1.0925484305920792 * vec3f(0.0, d.z, d.y);
        g[5] = 0.31539156525252005 * vec3f(-2.0 * d.x, -2.0 * d.y, 4.0 * d.z);
        g[6] = -1.0925484305920792 * vec3f(d.z, 0.0, d.x);
        g[7] = 0.5462742152960396 * vec3f(2.0 * d.x, -2.0 * d.y, 0.0);
    }
    if degree >= 3u {
        g[8] = -0.5900435899266435 * vec3f(6.0 * d.x * d.y, 3.0 * d.x * d.x - 3.0 * d.y * d.y, 0.0);
        g[9] = 2.890611442640554 * vec3f(d.y * d.z, d.x * d.z, d.x * d.y);
        g[10] = -0.4570457994644658 * vec3f(-2.0 * d.x * d.y, 4.0 * d.z * d.z - d.x * d.x - 3.0 * d.y * d.y, 8.0 * d.y * d.z);
        g[11] = 0.3731763325901154 * vec3f(-6.0 * d.x * d.z, -6.0 * d.y * d.z, 6.0 * d.z * d.z - 3.0 * d.x * d.x - 3.0 * d.y * d.y);
        g[12] = -0.4570457994644658 * vec3f(4.0 * d.z * d.z - 3.0 * d.x * d.x - d.y * d.y, -2.0 * d.x * d.y, 8.0 * d.x * d.z);
        g[13] = 1.445305721320277 * vec3f(2.0 * d.x * d.z, -2.0 * d.y * d.z, d.x * d.x - d.y * d.y);
        g[14] = -0.5900435899266435 * vec3f(3.0 * d.x * d.x - 3.0 * d.y * d.y, -6.0 * d.x * d.y, 0.0);
    }
    return g;
}
