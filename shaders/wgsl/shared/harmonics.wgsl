// Real spherical harmonics up to degree 3, with the signs of the original 3D Gaussian Splatting.
#define_import_path harmonics

const FLAT: f32 = 0.28209479177387814;
const LINEAR: f32 = 0.4886025119029199;
const XY: f32 = 1.0925484305920792;
const ZZ: f32 = 0.31539156525252005;
const XX_YY: f32 = 0.5462742152960396;
const YXX: f32 = 0.5900435899266435;
const XYZ: f32 = 2.890611442640554;
const YZZ: f32 = 0.4570457994644658;
const ZZZ: f32 = 0.3731763325901154;
const ZXX: f32 = 1.445305721320277;

// Coefficients per channel of a degree.
fn coefficients_of(degree: u32) -> u32 {
    return (degree + 1u) * (degree + 1u);
}

// The basis function number `k` at a unit direction.
fn basis(k: u32, d: vec3<f32>) -> f32 {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let s = d * d;
    switch k {
        case 0u: { return FLAT; }
        case 1u: { return -LINEAR * y; }
        case 2u: { return LINEAR * z; }
        case 3u: { return -LINEAR * x; }
        case 4u: { return XY * x * y; }
        case 5u: { return -XY * y * z; }
        case 6u: { return ZZ * (2.0 * s.z - s.x - s.y); }
        case 7u: { return -XY * x * z; }
        case 8u: { return XX_YY * (s.x - s.y); }
        case 9u: { return -YXX * y * (3.0 * s.x - s.y); }
        case 10u: { return XYZ * x * y * z; }
        case 11u: { return -YZZ * y * (4.0 * s.z - s.x - s.y); }
        case 12u: { return ZZZ * z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y); }
        case 13u: { return -YZZ * x * (4.0 * s.z - s.x - s.y); }
        case 14u: { return ZXX * z * (s.x - s.y); }
        default: { return -YXX * x * (s.x - 3.0 * s.y); }
    }
}

// Its gradient by the direction.
fn basis_gradient(k: u32, d: vec3<f32>) -> vec3<f32> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let s = d * d;
    switch k {
        case 0u: { return vec3(0.0); }
        case 1u: { return vec3(0.0, -LINEAR, 0.0); }
        case 2u: { return vec3(0.0, 0.0, LINEAR); }
        case 3u: { return vec3(-LINEAR, 0.0, 0.0); }
        case 4u: { return XY * vec3(y, x, 0.0); }
        case 5u: { return -XY * vec3(0.0, z, y); }
        case 6u: { return 2.0 * ZZ * vec3(-x, -y, 2.0 * z); }
        case 7u: { return -XY * vec3(z, 0.0, x); }
        case 8u: { return 2.0 * XX_YY * vec3(x, -y, 0.0); }
        case 9u: { return -3.0 * YXX * vec3(2.0 * x * y, s.x - s.y, 0.0); }
        case 10u: { return XYZ * vec3(y * z, x * z, x * y); }
        case 11u: { return -YZZ * vec3(-2.0 * x * y, 4.0 * s.z - s.x - 3.0 * s.y, 8.0 * y * z); }
        case 12u: { return ZZZ * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * s.z - 3.0 * s.x - 3.0 * s.y); }
        case 13u: { return -YZZ * vec3(4.0 * s.z - 3.0 * s.x - s.y, -2.0 * x * y, 8.0 * x * z); }
        case 14u: { return ZXX * vec3(2.0 * x * z, -2.0 * y * z, s.x - s.y); }
        default: { return -3.0 * YXX * vec3(s.x - s.y, -2.0 * x * y, 0.0); }
    }
}

// Direction from the camera centre; zero where they coincide, which leaves the colour of degree 0.
fn direction_of(offset: vec3<f32>) -> vec3<f32> {
    let largest = max(max(abs(offset.x), abs(offset.y)), abs(offset.z));
    if !(largest > 0.0) {
        return vec3(0.0);
    }
    let scaled = offset / largest;
    return scaled / sqrt(dot(scaled, scaled));
}
