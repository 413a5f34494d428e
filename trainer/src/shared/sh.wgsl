// sh: real spherical harmonics up to degree 3, in the order and with the signs of Kerbl et al. 2023.
//
// twin      model-files/src/spherical_harmonics.rs

const SH_0 = 0.28209479177387814;
const SH_1 = 0.4886025119029199;

// Calls the kernel's `add_sh_term(sums, k, basis, gradient)` for basis functions 1 to 15 (k: 0 to 14) at a unit
// direction, up to `degree`. The gradient is with respect to the direction; its components are treated as independent.
//
// The code calls a function for each basis function, because an array with a variable index would be placed in memory.
fn each_sh(sums: ptr<function, ShSums>, d: vec3f, degree: u32) {
    if degree >= 1u {
        add_sh_term(sums, 0u, -SH_1 * d.y, vec3f(0.0, -SH_1, 0.0));
        add_sh_term(sums, 1u, SH_1 * d.z, vec3f(0.0, 0.0, SH_1));
        add_sh_term(sums, 2u, -SH_1 * d.x, vec3f(-SH_1, 0.0, 0.0));
    }
    if degree >= 2u {
        add_sh_term(sums, 3u, 1.0925484305920792 * d.x * d.y, 1.0925484305920792 * vec3f(d.y, d.x, 0.0));
        add_sh_term(sums, 4u, -1.0925484305920792 * d.y * d.z, -1.0925484305920792 * vec3f(0.0, d.z, d.y));
        add_sh_term(sums, 5u, 0.31539156525252005 * (2.0 * d.z * d.z - d.x * d.x - d.y * d.y), 0.31539156525252005 * vec3f(-2.0 * d.x, -2.0 * d.y, 4.0 * d.z));
        add_sh_term(sums, 6u, -1.0925484305920792 * d.x * d.z, -1.0925484305920792 * vec3f(d.z, 0.0, d.x));
        add_sh_term(sums, 7u, 0.5462742152960396 * (d.x * d.x - d.y * d.y), 0.5462742152960396 * vec3f(2.0 * d.x, -2.0 * d.y, 0.0));
    }
    if degree >= 3u {
        add_sh_term(sums, 8u, -0.5900435899266435 * d.y * (3.0 * d.x * d.x - d.y * d.y), -0.5900435899266435 * vec3f(6.0 * d.x * d.y, 3.0 * d.x * d.x - 3.0 * d.y * d.y, 0.0));
        add_sh_term(sums, 9u, 2.890611442640554 * d.x * d.y * d.z, 2.890611442640554 * vec3f(d.y * d.z, d.x * d.z, d.x * d.y));
        add_sh_term(sums, 10u, -0.4570457994644658 * d.y * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y), -0.4570457994644658 * vec3f(-2.0 * d.x * d.y, 4.0 * d.z * d.z - d.x * d.x - 3.0 * d.y * d.y, 8.0 * d.y * d.z));
        add_sh_term(sums, 11u, 0.3731763325901154 * d.z * (2.0 * d.z * d.z - 3.0 * d.x * d.x - 3.0 * d.y * d.y), 0.3731763325901154 * vec3f(-6.0 * d.x * d.z, -6.0 * d.y * d.z, 6.0 * d.z * d.z - 3.0 * d.x * d.x - 3.0 * d.y * d.y));
        add_sh_term(sums, 12u, -0.4570457994644658 * d.x * (4.0 * d.z * d.z - d.x * d.x - d.y * d.y), -0.4570457994644658 * vec3f(4.0 * d.z * d.z - 3.0 * d.x * d.x - d.y * d.y, -2.0 * d.x * d.y, 8.0 * d.x * d.z));
        add_sh_term(sums, 13u, 1.445305721320277 * d.z * (d.x * d.x - d.y * d.y), 1.445305721320277 * vec3f(2.0 * d.x * d.z, -2.0 * d.y * d.z, d.x * d.x - d.y * d.y));
        add_sh_term(sums, 14u, -0.5900435899266435 * d.x * (d.x * d.x - 3.0 * d.y * d.y), -0.5900435899266435 * vec3f(3.0 * d.x * d.x - 3.0 * d.y * d.y, -6.0 * d.x * d.y, 0.0));
    }
}
