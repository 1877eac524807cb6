/* A step of the scaled gradient projection method, inside the transforms along the rows. */

INLINE vec shifted_scaling(
    const vec f, const vec shift, const vec weight, const vec curvature, const int is_smoothed,
    const real mu)
{
    const vec scaled = (f + shift) * weight;
    if (is_smoothed || mu != 0)
        return scaled / (1 + (mu + curvature) * scaled);
    return scaled;
}

/* D = (f + z) a / (1 + (mu + curvature) (f + z) a): a split gradient's own scaling, shifted by z.
 * Made twice, from what it is made of: to write it and read it back is slower.
 */
INLINE cvec scaling_at(
    const cvec f, __global const vec *shift, __global const vec *inverse_weight,
    __global const vec *curvature, const size_t at, const int i, const int has_weights,
    const int is_smoothed, const real mu)
{
    const cvec z = LOAD(OWN_LINE(shift + at, i), ALONG(i));
    const cvec weight =
        LOAD_MAP(OWN_MAP(inverse_weight + has_weights * at, has_weights, i), has_weights, ALONG(i));
    const cvec curved = smoothing_at(OWN_LINE(curvature + at, i), ALONG(i), is_smoothed);
    return (cvec){
        shifted_scaling(f.re, z.re, weight.re, curved.re, is_smoothed, mu),
        shifted_scaling(f.im, z.im, weight.im, curved.im, is_smoothed, mu)
    };
}

/* gradient' = mu f + slope - c, c = sum_j A_j^T (r_j - w_j), of each sky;
 * change_sums: <D y, s> and <D y, D y>, y = gradient' - gradient, s = f - previous,
 * D = (f + shift) a / (1 + (mu + curvature) (f + shift) a), a = 1 / sum_j A_j^T w_j.
 * spectra: N_SPECTRA arrays, const, of which the first n_skies are the row spectra of c.
 * gradient: n_skies arrays of pixels, updated. extended
 * (f), previous, shift: n_skies each, const. inverse_weight: n_skies arrays of pixels, a (has_weights),
 * or one point, [2][BLOCK], for all. slope, curvature: n_skies arrays of pixels each, const, those of f
 * (is_smoothed; else they count as 0). change_sums: [2][n_skies][ROW_BLOCKS][2]. steps[FRESH] 0: nothing.
 * Launch: up to ROW_BLOCKS groups a sky. In place. Scratch: NX points. Twin: reference.gradient_rows.
 */
KERNEL void gradient_rows(
    __global const vec *restrict spectra, __global real *restrict change_sums,
    __global vec *restrict gradient, __global const vec *restrict extended,
    __global const vec *restrict previous, __global const vec *restrict shift,
    __global const vec *restrict inverse_weight, __global const vec *restrict slope,
    __global const vec *restrict curvature, __global const real *restrict steps,
    const int has_weights, const int is_smoothed, const real mu, const int n_images,
    const int n_skies, __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(change_sums, 4 * ROW_BLOCKS * n_skies);
    OF_MEMBER(gradient, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(extended, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(previous, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(slope, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(curvature, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[FRESH], unit, ROW_BLOCKS * n_skies) {
        const size_t at = (size_t)unit * NX * 2 * SIDE;
        read_tiles(z, SPECTRA_OF_SKY(spectra, unit), unit % ROW_BLOCKS);
        dit_inner(z, NX, row_roots);
        finish_rows(z, NX, row_roots);
        vec_sum change_step = {0, 0}, change_change = {0, 0};
        FOR_EACH_POINT(i, NX) {
            const cvec a = POINT(z, i);
            const cvec f = LOAD(OWN_LINE(extended + at, i), ALONG(i));
            const cvec before = LOAD(OWN_LINE(previous + at, i), ALONG(i));
            const cvec g = LOAD(OWN_LINE(gradient + at, i), ALONG(i));
            const cvec down = smoothing_at(OWN_LINE(slope + at, i), ALONG(i), is_smoothed);
            const cvec d = scaling_at(
                f, shift, inverse_weight, curvature, at, i, has_weights, is_smoothed, mu);
            const cvec next = {mu * f.re + down.re - a.re, mu * f.im + down.im - a.im};
            const cvec change = {d.re * (next.re - g.re), d.im * (next.im - g.im)};
            ACCUMULATE(
                change_step, change.re * (f.re - before.re) + change.im * (f.im - before.im));
            ACCUMULATE(change_change, change.re * change.re + change.im * change.im);
            STORE(OWN_LINE(gradient + at, i), ALONG(i), next);
        }
        store_pair(change_sums + 2 * unit, sum_group(sum_lanes(change_step), shared));
        store_pair(
            change_sums + 2 * (ROW_BLOCKS * n_skies + unit),
            sum_group(sum_lanes(change_change), shared));
        BARRIER;
    }
}

/* previous = f; f <- f + d, d = P(f - alpha D gradient) - f, P the projection on f >= 0; where the
 * last step was refused f <- previous + SHORTER (f - previous) instead, which shortens d.
 * spectra <- row spectrum of f; step_sums: <gradient, d>;
 * coupling_sums: <cross_information_s, d>; square_sums: sum f^2; of each sky.
 * spectra: N_SPECTRA arrays, of which the first n_skies are out: twice the row spectra.
 * extended (f): n_skies arrays of pixels, updated.
 * previous: as many, written, or read. gradient, shift: as many, const; inverse_weight, curvature: as
 * for gradient_rows, which has D and change_sums. steps[GOING] 0: nothing.
 * cross_information: [n_stars], a window of cross_blocks blocks and cross_columns columns each;
 * cross_corners: [n_stars][2]; cross_near: the stars of each block, see stars.cl.
 * coupling_sums: [n_skies][n_stars][cross_blocks][2].
 * step_sums, square_sums: [n_skies][ROW_BLOCKS][2].
 * Launch: up to ROW_BLOCKS groups a sky. In place. Scratch: NX points. Twin: reference.step_rows.
 */
KERNEL void step_rows(
    __global vec *restrict spectra, __global vec *restrict extended,
    __global real *restrict step_sums, __global real *restrict coupling_sums,
    __global real *restrict square_sums, __global vec *restrict previous,
    __global const vec *restrict gradient, __global const vec *restrict shift,
    __global const vec *restrict inverse_weight, __global const vec *restrict curvature,
    __global const vec *restrict cross_information, __global const int *restrict cross_corners,
    __global const int *restrict cross_near, __global const real *restrict steps,
    __global const real *restrict change_sums, const int has_weights, const int is_smoothed,
    const real mu, const int n_images, const int n_skies, const int n_stars, const int cross_blocks,
    const int cross_columns, __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SHARED_SUMS(shared);
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(extended, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(step_sums, 2 * ROW_BLOCKS * n_skies);
    OF_MEMBER(coupling_sums, n_skies * n_stars * cross_blocks * 2);
    OF_MEMBER(square_sums, 2 * ROW_BLOCKS * n_skies);
    OF_MEMBER(previous, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(gradient, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(curvature, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    OF_MEMBER(change_sums, 4 * ROW_BLOCKS * n_skies);
    const real alpha = next_alpha(steps, next_length(steps, change_sums, n_skies, shared));
    const bool is_new = steps[SHORTENED] == 0;
    FOR_EACH_BLOCK_IF(steps[GOING], unit, ROW_BLOCKS * n_skies) {
        const int sky = unit / ROW_BLOCKS, block = unit % ROW_BLOCKS;
        const size_t at = (size_t)unit * NX * 2 * SIDE;
        const bool has_stars = cross_near[block] < cross_near[block + 1];
        vec_sum slope_total = {0, 0}, square_total = {0, 0};
        /* A pass of its own over the pixels in their order, which prefetching follows: inside the
         * transform they come from too many places at once.
         */
        if (is_new) {
            FOR_EACH_POINT(i, NX) {
                const cvec f = LOAD(OWN_LINE(extended + at, i), ALONG(i));
                const cvec g = LOAD(OWN_LINE(gradient + at, i), ALONG(i));
                const cvec scale = scaling_at(
                    f, shift, inverse_weight, curvature, at, i, has_weights, is_smoothed, mu);
                const cvec trial = {
                    not_below_0(f.re - alpha * scale.re * g.re),
                    not_below_0(f.im - alpha * scale.im * g.im)
                };
                const cvec d = {trial.re - f.re, trial.im - f.im};
                STORE(OWN_LINE(previous + at, i), ALONG(i), f);
                STORE(OWN_LINE(extended + at, i), ALONG(i), trial);
                ACCUMULATE(slope_total, g.re * d.re + g.im * d.im);
                if (has_stars)
                    SET_POINT(z, i, d);
                if (mu != 0)
                    ACCUMULATE(square_total, trial.re * trial.re + trial.im * trial.im);
            }
        } else {
            FOR_EACH_POINT(i, NX) {
                const cvec before = LOAD(OWN_LINE(previous + at, i), ALONG(i));
                const cvec f = LOAD(OWN_LINE(extended + at, i), ALONG(i));
                const cvec trial = {
                    before.re + SHORTER * (f.re - before.re),
                    before.im + SHORTER * (f.im - before.im)
                };
                STORE(OWN_LINE(extended + at, i), ALONG(i), trial);
                if (has_stars) /* which know how they follow */
                    SET_POINT(z, i, trial);
                if (mu != 0)
                    ACCUMULATE(square_total, trial.re * trial.re + trial.im * trial.im);
            }
        }
        BARRIER;
        sum_products(
            coupling_sums + sky * n_stars * cross_blocks * 2, z, cross_information, cross_corners,
            cross_near, 1, 0, cross_blocks, cross_columns, block, ROW_BLOCKS, NX, shared);
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            UNROLL_IN_GROUPS
            for (int q = 0; q < OUTER(NX); ++q)
                a[q] = LOAD(FROM_POINT(extended + at, x, lane), q * INNER(NX));
            store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
        }
        store_pair(step_sums + 2 * unit, sum_group(sum_lanes(slope_total), shared));
        store_pair(square_sums + 2 * unit, sum_group(sum_lanes(square_total), shared));
        BARRIER;
        dif_inner(z, NX, row_roots);
        write_tiles(SPECTRA_OF_SKY(spectra, unit), z, block, 1);
    }
}
