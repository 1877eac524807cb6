/* A transmission of the sky before the PSF, t_j of image j: a coronagraph, or vignetting. */

/* spectra_j = 2 sum_x t_j(x) f_j(x) exp(-2 pi i k x / NX), f_j = sum_k mixes_jk f_k: the row spectra of
 * the sky of each image.
 * extended: n_skies arrays of pixels, f_k, const. transmission: n_images arrays of pixels, const.
 * mixes: [n_images][n_skies]. spectra: N_SPECTRA arrays, those of the images are written, all of them
 * but their padding. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. Out of place. Scratch: NX points.
 * Twin: reference.transmit_rows.
 */
KERNEL void transmit_rows(
    __global vec *restrict spectra, __global const vec *restrict extended,
    __global const vec *restrict transmission, __global const real *restrict mixes,
    __global const real *restrict steps, const int n_images, const int n_skies,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(extended, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        for (int image = 0; image < n_images; ++image) {
            __global const vec *t = transmission + (size_t)image * PIXELS_SIZE + at;
            __global const real *mix = mixes + image * n_skies;
            FOR_EACH(piece, INNER(NX) * SIDE) {
                const int x = piece / SIDE, lane = piece % SIDE;
                cvec a[OUTER(NX)];
                UNROLL
                for (int q = 0; q < OUTER(NX); ++q) {
                    const int pixel = q * INNER(NX);
                    __global const vec *f = FROM_POINT(extended + at, x, lane);
                    const cvec share = LOAD(FROM_POINT(t, x, lane), pixel);
                    cvec seen = times(LOAD(f, pixel), mix[0]);
                    for (int k = 1; k < n_skies; ++k)
                        seen = add(seen, times(LOAD(f + (size_t)k * PIXELS_SIZE, pixel), mix[k]));
                    a[q] = (cvec){seen.re * share.re, seen.im * share.im};
                }
                store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
            }
            BARRIER;
            dif_inner(z, NX, row_roots);
            write_tiles(spectra + IMAGE_SPECTRA(image, n_skies), z, block, 1);
        }
    }
}

/* skies_k <- row spectrum of sum_j mixes_jk t_j c_j, with c_j that of spectra_j: the adjoint.
 * spectra: N_SPECTRA arrays, of which those of skies alone are written, the last, which image 0 shares,
 * after the others. transmission, mixes: as above.
 * transmitted: one array of pixels, for sums so far. steps[FRESH] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. In place. Scratch: NX points. Twin: reference.gather_rows.
 */
KERNEL void gather_rows(
    __global vec *restrict spectra, __global vec *restrict transmitted,
    __global const vec *restrict transmission, __global const real *restrict mixes,
    __global const real *restrict steps, const int n_images, const int n_skies,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    const real norm = (real)1 / 2 / NX;
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(transmitted, PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[FRESH], block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        for (int unit = 0; unit < n_skies * n_images; ++unit) {
            const int sky = unit / n_images, image = unit % n_images;
            const real scale = norm * mixes[image * n_skies + sky];
            __global const vec *t = transmission + (size_t)image * PIXELS_SIZE + at;
            read_tiles(z, spectra + IMAGE_SPECTRA(image, n_skies), block);
            dit_inner(z, NX, row_roots);
            FOR_EACH(piece, INNER(NX) * SIDE) {
                const int x = piece / SIDE, lane = piece % SIDE;
                cvec a[OUTER(NX)];
                load_inverse(a, OF_LANE(z, lane), x, NX, row_roots);
                UNROLL_IN_GROUPS
                for (int q = 0; q < OUTER(NX); ++q) {
                    const int pixel = q * INNER(NX);
                    __global vec *sum = FROM_POINT(transmitted + at, x, lane);
                    const cvec share = LOAD(FROM_POINT(t, x, lane), pixel);
                    a[q] = (cvec){scale * a[q].re * share.re, scale * a[q].im * share.im};
                    if (image > 0)
                        a[q] = add(a[q], LOAD(sum, pixel));
                    STORE(sum, pixel, a[q]);
                }
                if (image == n_images - 1)
                    store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
            }
            BARRIER;
            if (image == n_images - 1) {
                dif_inner(z, NX, row_roots);
                write_tiles(spectra + (size_t)sky * SPECTRA_SIZE, z, block, 1);
            }
        }
    }
}
