/* Model, ratio and objective, inside the transforms along the rows. */

#define LN_2 ((real)0.69314718055994530942)
#define INTEGER_SHIFT ((real)(sizeof(real) == 8 ? 0x1.8p52 : 0x1.8p23))
#define MANTISSA_BITS (sizeof(real) == 8 ? 52 : 23)
#define EXPONENT_MASK ((ivec)(-1) << MANTISSA_BITS)
#define SQRT_HALF_BITS as_ivec((vec)SQRT_HALF)

/* Small integers as reals, by way of the mantissa: PoCL 3 has no working convert_ for vectors. */
INLINE vec to_vec(const ivec i)
{
    return as_vec(i + as_ivec((vec)INTEGER_SHIFT)) - INTEGER_SHIFT;
}

/* EXCESS(w) = ((1 + w) ln(1 + w) - w) / w^2 on sqrt(1/2) <= 1 + w <= sqrt(2), as the polynomials of
 * least relative error: 3.4e-8 (single) and 4.3e-18 (double), lowest power first.
 */
#define EXCESS_DEGREE (sizeof(real) == 8 ? 19 : 7)
__constant real EXCESS_SINGLE[20] = {
    0.499999994036, -0.166667030814, 0.0833351303869, -0.0499698634792, 0.0332326961244,
    -0.0244001962804, 0.0197819679818, -0.0113388027335
};
__constant real EXCESS_DOUBLE[20] = {
    0.50000000000000000215, -0.166666666666666654085, 0.0833333333333297826706,
    -0.0500000000000042274666, 0.033333333334302597163, -0.0238095238096925575708,
    0.0178571427550196966678, -0.013888888781063092736, 0.0111111164818332906035,
    -0.00909091863639878838712, 0.00757560157763561145795, -0.00640987226344260975124,
    0.00549704355006335305903, -0.00477018125493779641286, 0.00414575977874774949627,
    -0.00357901880385661220521, 0.00331056735306297942329, -0.00349336603027412579098,
    0.00310930270637649836929, -0.00136134218335410395335
};
#define EXCESS(k) (sizeof(real) == 8 ? EXCESS_DOUBLE[k] : EXCESS_SINGLE[k])

/* m (r ln r - r + 1), which is g ln(g / m) + m - g for r = g / m, without its cancellation.
 *
 * With r = 2^e (1 + w), r ln r - r + 1 = 2^e w^2 EXCESS(w) + e ln(2) r + 1 - 2^e; where e = 0 only
 * the first term is left. At r = 0 the bits give 2^e = 0 and w = 0. Even and odd powers are summed
 * apart, so that neither waits for the other.
 */
INLINE vec divergence(const vec m, const vec r)
{
    const ivec exponent = (as_ivec(r) - SQRT_HALF_BITS) & EXPONENT_MASK;
    const vec power = as_vec(exponent + as_ivec((vec)1));
    const vec e = to_vec(exponent >> MANTISSA_BITS);
    const vec w = as_vec(as_ivec(r) - exponent) - 1, w2 = w * w;
    vec odd = EXCESS(EXCESS_DEGREE), even = EXCESS(EXCESS_DEGREE - 1);
    UNROLL
    for (int k = EXCESS_DEGREE - 2; k > 0; k -= 2) {
        odd = odd * w2 + EXCESS(k);
        even = even * w2 + EXCESS(k - 1);
    }
    return m * (r * (e * LN_2) + (1 - power) + power * w2 * (even + w * odd));
}

/* w (g / m - 1) and the data term of the objective; g < 0: not observed, w = 0. The guard: m counts
 * as MIN_MODEL where it is less, and g / m as 0 there, as the light that it wants is nowhere.
 * A transform's rounding is a share of what it is given: of g / m - 1, the noise, it is less than of
 * g / m, which is about 1 everywhere.
 */
INLINE vec ratio(const vec g, const vec m, vec *term)
{
    const ivec hidden = g < 0;              /* which NaN is not: it reaches the objective */
    const ivec dark = m <= (real)MIN_MODEL; /* nor this */
    const vec modelled = dark ? (vec)(real)MIN_MODEL : m;
    const vec quotient = g / modelled;
    const vec r = dark ? (vec)0 : quotient;
    const vec apart = divergence(modelled, quotient);
    *term = hidden ? (vec)0 : apart;
    return hidden ? (vec)0 : r - 1;
}

/* z <- r_j - w_j, from A_j f in a block of rows of an image; ratio_sums and star_sums of the block. */
INLINE void compare(
    LINES z, __global real *ratio_sums, __global real *star_sums, __global const vec *images,
    __global const vec *background, const int has_background_map, __global const vec *exposure,
    const int has_exposure_map, __global const vec *star_images, __global const int *star_corners,
    __global const int *star_near, __global const real *star_fluxes, const int n_images,
    const int star_blocks, const int star_columns, const int block, const int image,
    __local real_sum *shared)
{
    const size_t at = (size_t)image * IMAGE_SIZE + (size_t)block * IMAGE_NX * 2 * SIDE;
    const int unit = image * IMAGE_ROW_BLOCKS + block;
    for (int near = star_near[unit]; near < star_near[unit + 1]; ++near) {
        const int s = star_near[near], w = s * n_images + image;
        const int window = window_block(star_corners, w, star_blocks, block, IMAGE_ROW_BLOCKS);
        __global const vec *star = WINDOW_BLOCK(star_images, window, star_columns);
        const real flux = star_fluxes[s];
        const int corner = star_corners[2 * w + 1];
        FOR_EACH_IN_WINDOW(i, corner, star_columns, IMAGE_NX) {
            const int own = IN_LINES(i, corner, IMAGE_NX);
            const cvec p = LOAD(star + LANE_OF(i), COLUMN_OF(i, corner, IMAGE_NX));
            const cvec m = POINT(z, own), sum = {m.re + flux * p.re, m.im + flux * p.im};
            SET_POINT(z, own, sum);
        }
        BARRIER;
    }
    background += has_background_map ? at : image * 2 * SIDE;
    exposure += has_exposure_map * at;
    vec_sum objective = {0, 0};
    FOR_EACH_POINT(i, IMAGE_NX) {
        const cvec g = LOAD(OWN_LINE(images + at, i), ALONG(i));
        const cvec b =
            LOAD_MAP(OWN_MAP(background, has_background_map, i), has_background_map, ALONG(i));
        const cvec w = LOAD_MAP(OWN_MAP(exposure, has_exposure_map, i), has_exposure_map, ALONG(i));
        cvec a = add(POINT(z, i), b), term;
        a.re = ratio(g.re, a.re, &term.re);
        a.im = ratio(g.im, a.im, &term.im);
        a = (cvec){a.re * w.re, a.im * w.im};
        term = (cvec){term.re * w.re, term.im * w.im};
        ACCUMULATE(objective, term.re + term.im);
        SET_POINT(z, i, a);
    }
    BARRIER;
    sum_products(
        star_sums, z, star_images, star_corners, star_near, n_images, image, star_blocks,
        star_columns, block, IMAGE_ROW_BLOCKS, IMAGE_NX, shared);
    store_pair(
        ratio_sums + 2 * (block * n_images + image), sum_group(sum_lanes(objective), shared));
}

/* m_j = A_j f + sum_s c_s P_js + b_j;  r_j = w_j g_j / m_j;  spectra <- row spectra of r_j - w_j;
 * ratio_sums: J_0 = sum w_j (g_j ln(g_j / m_j) + m_j - g_j); star_sums: <P_js, r_j - w_j>.
 * spectra: N_SPECTRA arrays, of the images in: row spectra of A_j f, out: twice those of r_j - w_j.
 * images: n_images arrays of pixels, negative where not observed.
 * background: n_images arrays of pixels (has_background_map), or of one point, [2][BLOCK].
 * exposure: n_images arrays of pixels, w (has_exposure_map), or one point, [2][BLOCK], for all.
 * star_images: [n_stars][n_images], a window of star_blocks blocks and star_columns columns each;
 * star_corners: [n_stars][n_images][2]; star_near: the stars of each block, see stars.cl.
 * star_fluxes: [n_stars].
 * ratio_sums: [IMAGE_ROW_BLOCKS][n_images][2]. star_sums: [n_stars][n_images][star_blocks][2].
 * steps[GOING] 0: nothing.
 * Launch: up to IMAGE_ROW_BLOCKS n_images groups. In place. Scratch: NX points, and where
 * OVERSAMPLE > 1 IMAGE_NX more.
 * Twin: reference.ratio_rows.
 */
KERNEL void ratio_rows(
    __global vec *restrict spectra, __global real *restrict ratio_sums,
    __global real *restrict star_sums, __global const vec *restrict images,
    __global const vec *restrict background, const int has_background_map,
    __global const vec *restrict exposure, const int has_exposure_map,
    __global const vec *restrict star_images, __global const int *restrict star_corners,
    __global const int *restrict star_near, __global const real *restrict star_fluxes,
    __global const real *restrict steps, const int n_images, const int n_skies, const int n_stars,
    const int star_blocks, const int star_columns, __global const real *restrict image_row_roots,
    SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    LINES_IN(wide, scratch, NX + (OVERSAMPLE > 1 ? IMAGE_NX : 0));
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(ratio_sums, IMAGE_ROW_BLOCKS * n_images * 2);
    OF_MEMBER(star_sums, (size_t)n_stars * n_images * star_blocks * 2);
    OF_MEMBER(images, (size_t)n_images * IMAGE_SIZE);
    OF_MEMBER(star_fluxes, n_stars);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, IMAGE_ROW_BLOCKS * n_images) {
        const int block = unit / n_images, image = unit % n_images;
        __global vec *row_spectra = spectra + IMAGE_SPECTRA(image, n_skies);
        read_tiles(wide, row_spectra, block);
        LINES z = fold_rows(wide);
        dit_inner(z, IMAGE_NX, image_row_roots);
        finish_rows(z, IMAGE_NX, image_row_roots);
        compare(
            z, ratio_sums, star_sums, images, background, has_background_map, exposure,
            has_exposure_map, star_images, star_corners, star_near, star_fluxes, n_images,
            star_blocks, star_columns, block, image, shared);
        begin_rows(z, IMAGE_NX, image_row_roots);
        dif_inner(z, IMAGE_NX, image_row_roots);
        write_tiles(row_spectra, z, block, OVERSAMPLE);
    }
}
