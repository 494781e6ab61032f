/* Loops over the cells of the error of the mesh: tractions in balance around nodes, Neumann problems,
   and conjugate gradients over tractions with facets and rings of cells as preconditioner. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define INLINE static inline __attribute__((always_inline))

typedef ptrdiff_t size;
/* numbers that are computed with at once */
#define PACK 8
typedef double pack __attribute__((vector_size(8 * PACK), aligned(8), may_alias));
#define AT(x) (*(pack *)(x))
#define CONST_AT(x) (*(const pack *)(x))
/* most resultants of tractions: three forces, three moments */
#define RESULTANTS 6

/* -- order --------------------------------------------------------------------------------- */

/* Order the places (places,) of keys below a number by their keys: those of key i are
   order[first[i]], ..., in ascending order. `first` has room for number + 1. */
void mesh_error_order(size places, size number, const int32_t *key, int32_t *order, int32_t *first)
{
  memset(first, 0, (number + 1) * sizeof *first);
  for (size i = 0; i < places; i++)
    first[key[i] + 1]++;
  for (size i = 0; i < number; i++)
    first[i + 1] += first[i];
  for (size i = 0; i < places; i++)
    order[first[key[i]]++] = (int32_t)i;
  for (size i = number; i > 0; i--)
    first[i] = first[i - 1];
  first[0] = 0;
}

/* -- small matrices ------------------------------------------------------------------------ */

/* Replace the upper triangle of A (w, w) by the factor U of A = U'U, with the inverses of its
   diagonal; false where A is not positive definite. */
static int factorise(size w, double *A)
{
  for (size j = 0; j < w; j++) {
    double *row = A + j * w;
    if (!(row[j] > 0.0))
      return 0;
    double inverse = 1.0 / sqrt(row[j]);
    for (size i = j + 1; i < w; i++)
      row[i] *= inverse;
    row[j] = inverse;
    for (size k = j + 1; k < w; k++)
      for (size i = k; i < w; i++)
        A[k * w + i] -= row[k] * row[i];
  }
  return 1;
}

/* Solve U'y = y for some packs of columns of Y (w, stride). */
INLINE void forward_packs(size w, const double *U, double *Y, size stride, const int packs)
{
  for (size i = 0; i < w; i++) {
    pack sum[4];
    for (int p = 0; p < packs; p++)
      sum[p] = AT(Y + i * stride + p * PACK);
    for (size j = 0; j < i; j++)
      for (int p = 0; p < packs; p++)
        sum[p] -= U[j * w + i] * AT(Y + j * stride + p * PACK);
    for (int p = 0; p < packs; p++)
      AT(Y + i * stride + p * PACK) = sum[p] * U[i * w + i];
  }
}

/* Solve U'y = y for columns of Y (w, stride), a multiple of PACK. */
static void forward(size w, const double *U, double *Y, size stride, size columns)
{
  size packs = columns / PACK;
  for (; packs >= 4; packs -= 4, Y += 4 * PACK)
    forward_packs(w, U, Y, stride, 4);
  for (; packs >= 2; packs -= 2, Y += 2 * PACK)
    forward_packs(w, U, Y, stride, 2);
  if (packs)
    forward_packs(w, U, Y, stride, 1);
}

/* Solve Uy = y for b columns of Y (w, b). */
static void backward(size w, const double *U, double *Y, size b)
{
  for (size i = w - 1; i >= 0; i--)
    for (size c = 0; c < b; c++) {
      double sum = Y[i * b + c];
      for (size j = i + 1; j < w; j++)
        sum -= U[i * w + j] * Y[j * b + c];
      Y[i * b + c] = sum * U[i * w + i];
    }
}

/* Solve U'y = y for b columns of Y (w, b). */
static void forward_few(size w, const double *U, double *Y, size b)
{
  for (size i = 0; i < w; i++)
    for (size c = 0; c < b; c++) {
      double sum = Y[i * b + c];
      for (size j = 0; j < i; j++)
        sum -= U[j * w + i] * Y[j * b + c];
      Y[i * b + c] = sum * U[i * w + i];
    }
}

/* Replace a symmetric matrix (n, n) by its inverse, with a shift of each diagonal entry, relative
   to it; by zero where it is not positive definite. `work` has room for n * n. */
static void invert(size n, double *A, double shift, double *work)
{
  memset(work, 0, n * n * sizeof *work);
  for (size i = 0; i < n; i++) {
    A[i * n + i] *= 1.0 + shift;
    work[i * n + i] = 1.0;
  }
  if (!factorise(n, A)) {
    memset(A, 0, n * n * sizeof *A);
    return;
  }
  forward_few(n, A, work, n);
  backward(n, A, work, n);
  memcpy(A, work, n * n * sizeof *A);
}

/* -- tractions in balance around nodes ----------------------------------------------------- */

static int root(int *parent, int i)
{
  while (parent[i] != i)
    i = parent[i] = parent[parent[i]];
  return i;
}

/* Moments in balance with forces of the cells around each node, nearest to given ones.

   Nodes that are not `skipped` are treated. The pairs of a cell and a node at node i are pair[first[i]], ...; pair p has the force (p, d, v).
   Its moments are the rows (p / n) * stride + offset[(p % n) * h], ... of `own` (rows, d), offsets
   below zero are none; row r is on facet[r / t], where the components free[r / t] (d,) may change.
   `out` (rows, d, v) become the moments in balance; it may be `own` if v is 1. `imbalance`
   (nodes, d) becomes the largest sum of forces of cells that nothing holds. `most` is the largest
   number of pairs at a node; `work` has room for most * (most + 2 * h * d + 2 * d * v) numbers and
   `numbers` for most * (4 * h + 2). */
void mesh_error_nodes(size nodes, const uint8_t *skipped, const int32_t *first, const int32_t *pair, size n, size stride, size h, const int32_t *offset, size t, const int32_t *facet,
                      const uint8_t *free, size d, size v, const double *force, const double *own,
                      double *out, double *imbalance, size most, double *work, int *numbers)
{
  double *A = work, *start = A + most * most, *b = start + most * h * d, *y = b + most * d * v;
  int *left = numbers, *right = left + most * h, *parent = right + most * h, *held = parent + most;
  for (size i = 0; i < nodes; i++) {
    if (skipped[i])
      continue;
    const int32_t *pairs = pair + first[i];
    int cells = first[i + 1] - first[i], columns = 0;
    int *rows = held + most;
    /* both sides of each moment: the second of none is -1 */
    for (int k = 0; k < cells; k++)
      for (size q = 0; q < h; q++) {
        size p = pairs[k], at = offset[(p % n) * h + q];
        if (at < 0)
          continue;
        size r = (p / n) * stride + at;
        int c = 0;
        while (c < columns && (right[c] >= 0 || facet[rows[2 * c] / t] != facet[r / t]))
          c++;
        if (c == columns) {
          left[c] = k, right[c] = -1, rows[2 * c] = (int)r, rows[2 * c + 1] = -1;
          columns++;
        } else
          right[c] = k, rows[2 * c + 1] = (int)r;
      }
    int is_equal = 1;
    for (int c = 0; c < columns; c++) {
      const uint8_t *may = free + (rows[2 * c] / t) * d;
      for (size a = 0; a < d; a++) {
        double sum = own[rows[2 * c] * d + a];
        if (right[c] >= 0)
          sum = 0.5 * (sum - own[rows[2 * c + 1] * d + a]);
        start[c * d + a] = may[a] ? sum : 0.0;
        is_equal &= may[a] == may[0];
      }
    }
    for (int k = 0; k < cells; k++)
      for (size a = 0; a < d * v; a++)
        b[k * d * v + a] = -force[pairs[k] * d * v + a];
    for (int c = 0; c < columns; c++)
      for (size a = 0; a < d; a++)
        for (size w = 0; w < v; w++) {
          b[(left[c] * d + a) * v + w] -= start[c * d + a];
          if (right[c] >= 0)
            b[(right[c] * d + a) * v + w] += start[c * d + a];
        }
    /* all components at once where all have the same matrix */
    size together = is_equal ? d : 1, z = together * v;
    for (size a = 0; a < d; a += together) {
      memset(A, 0, cells * cells * sizeof *A);
      for (int k = 0; k < cells; k++)
        parent[k] = k, held[k] = 0;
      for (int c = 0; c < columns; c++) {
        if (!free[(rows[2 * c] / t) * d + a])
          continue;
        int l = left[c], r = right[c];
        A[l * cells + l] += 1.0;
        if (r < 0)
          continue;
        A[r * cells + r] += 1.0;
        A[l * cells + r] -= 1.0;
        A[r * cells + l] -= 1.0;
        parent[root(parent, l)] = root(parent, r);
      }
      for (int c = 0; c < columns; c++)
        if (right[c] < 0 && free[(rows[2 * c] / t) * d + a])
          held[root(parent, left[c])] = 1;
      for (int k = 0; k < cells; k++)
        memcpy(y + k * z, b + (k * d + a) * v, z * sizeof *y);
      /* what nothing holds is held by a number: its forces are in balance */
      for (int k = 0; k < cells; k++) {
        if (root(parent, k) != k || held[k])
          continue;
        A[k * cells + k] += 1.0;
        for (size w = 0; w < z; w++) {
          double sum = 0.0, count = 0.0;
          for (int l = 0; l < cells; l++)
            if (root(parent, l) == k)
              sum += y[l * z + w], count += 1.0;
          for (int l = 0; l < cells; l++)
            if (root(parent, l) == k)
              y[l * z + w] -= sum / count;
          double *largest = imbalance + i * d + a + w / v;
          *largest = fmax(*largest, fabs(sum));
        }
      }
      factorise(cells, A);
      forward_few(cells, A, y, z);
      backward(cells, A, y, z);
      for (int c = 0; c < columns; c++) {
        const uint8_t *may = free + (rows[2 * c] / t) * d;
        for (size w = 0; w < z; w++) {
          size component = a + w / v;
          double difference = y[left[c] * z + w] - (right[c] < 0 ? 0.0 : y[right[c] * z + w]);
          double value = may[component] ? start[c * d + component] + difference : 0.0;
          out[rows[2 * c] * d * v + a * v + w] = value;
          if (right[c] >= 0)
            out[rows[2 * c + 1] * d * v + a * v + w] = -value;
        }
      }
    }
  }
}

/* -- Neumann problems ---------------------------------------------------------------------- */

/* Subtract internal forces Au from loads (cells, w, v) for displacements u (cells, w); `energy`
   (cells,) becomes u'Au. Cell k has the matrix A (number[k], w, w). */
void mesh_error_internal(size cells, size w, size v, const int32_t *number, const double *A,
                         const double *u, double *load, double *energy)
{
  for (size k = 0; k < cells; k++) {
    const double *of_cell = u + k * w;
    energy[k] = 0.0;
    for (size i = 0; i < w; i++) {
      const double *row = A + ((size)number[k] * w + i) * w;
      pack sums = {0};
      size j = 0;
      for (; j + PACK <= w; j += PACK)
        sums += CONST_AT(row + j) * CONST_AT(of_cell + j);
      double sum = 0.0;
      for (int p = 0; p < PACK; p++)
        sum += sums[p];
      for (; j < w; j++)
        sum += row[j] * of_cell[j];
      for (size a = 0; a < v; a++)
        load[(k * w + i) * v + a] -= sum;
      energy[k] += sum * of_cell[i];
    }
  }
}

/* Add stiffness against the rigid motions of cells with nodes x (cells, w / d, d), which loads in
   balance do not move, to matrices A (cells, w, w): to their upper triangles. A cell that may resist
   them by itself, by more than a limit relative to its trace, is marked in `resisted` (cells,)
   instead. `work` has room for (RESULTANTS + 1) * w numbers. */
void mesh_error_hold(size cells, size w, size d, double limit, const double *x, double *A,
                     uint8_t *resisted, double *work)
{
  size n = w / d, motions = d == 2 ? 3 : 6;
  double *R = work, *force = work + RESULTANTS * w;
  for (size k = 0; k < cells; k++) {
    const double *points = x + k * w;
    double *matrix = A + k * w * w, middle[3] = {0}, trace = 0.0, largest = 0.0;
    memset(R, 0, motions * w * sizeof *R);
    for (size i = 0; i < w; i++) {
      middle[i % d] += points[i] / n;
      trace += matrix[i * w + i];
      R[(i % d) * w + i] = 1.0 / sqrt((double)n);
    }
    for (size q = 0; q < motions - d; q++) {
      size a = q, b = (q + 1) % d;
      double *turn = R + (d + q) * w, square = 0.0;
      for (size i = 0; i < n; i++) {
        double xa = points[i * d + a] - middle[a], xb = points[i * d + b] - middle[b];
        turn[i * d + a] = -xb, turn[i * d + b] = xa;
        square += xa * xa + xb * xb;
      }
      for (size i = 0; i < w; i++)
        turn[i] /= sqrt(square);
    }
    for (size q = 0; q < motions; q++) {
      memset(force, 0, w * sizeof *force);
      for (size i = 0; i < w; i++)
        for (size j = 0; j < w && R[q * w + i] != 0.0; j++)
          force[j] += R[q * w + i] * matrix[i * w + j];
      for (size j = 0; j < w; j++)
        largest = fmax(largest, fabs(force[j]));
    }
    resisted[k] = !(largest * sqrt((double)w) < limit * trace);
    if (resisted[k])
      continue;
    for (size i = 0; i < w; i++)
      for (size q = 0; q < motions; q++) {
        double factor = trace / w * R[q * w + i];
        for (size j = i; j < w && factor != 0.0; j++)
          matrix[i * w + j] += factor * R[q * w + j];
      }
  }
}

/* Rows of a product that are computed at once. */
#define ROWS 6

/* Compute G = X'Y for rows [0, rows) and a pack of columns, from Y (w, stride) that has both. */
INLINE void product(size w, const double *X, const double *Y, size stride, size rows, size columns,
                    double *G, size leading)
{
  for (size a = 0; a < rows; a += ROWS) {
    pack sum[ROWS] = {{0}};
    for (size i = 0; i < w; i++)
      for (int p = 0; p < ROWS; p++)
        sum[p] += X[i * stride + a + p] * CONST_AT(Y + i * stride);
    for (int p = 0; p < ROWS && a + p < rows; p++)
      for (size b = 0; b < columns; b++)
        G[(a + p) * leading + b] = sum[p][b];
  }
}

/* B'A^{-1}B for B = [lift (w, s), load (w, v)] of each cell: matrices (classes, s, s), gradients
   (cells, s, v) and the diagonals (cells, v) of the columns of loads.

   Cells of a class, member[first[c]], ..., have the same A (classes, w, w), of which the upper
   triangle is used, and lost. `work` has room for w * (stride) numbers, where stride is s + PACK * v
   rounded up to whole packs, and 2 packs. Returns the number of classes before the first whose A is
   not positive definite. */
size mesh_error_products(size classes, size w, size s, size v, size stride, const int32_t *first,
                         const int32_t *member, double *A, const double *lift, const double *load,
                         double *matrix, double *gradient, double *constant, double *work)
{
  double *Y = work;
  for (size k = 0; k < classes; k++) {
    double *U = A + k * w * w, *Q = matrix + k * s * s;
    if (!factorise(w, U))
      return k;
    for (size m = first[k]; m < first[k + 1]; m += PACK) {
      size cells = first[k + 1] - m < PACK ? first[k + 1] - m : PACK, b = cells * v;
      size columns = (s + b + PACK - 1) / PACK * PACK, is_first = m == first[k];
      for (size i = 0; i < w; i++) {
        double *row = Y + i * stride;
        if (is_first)
          memcpy(row, lift + i * s, s * sizeof *row);
        for (size c = 0; c < cells; c++)
          for (size a = 0; a < v; a++)
            row[s + c * v + a] = load[((size)member[m + c] * w + i) * v + a];
        memset(row + s + b, 0, (stride - s - b) * sizeof *row);
      }
      if (is_first)
        forward(w, U, Y, stride, columns);
      else
        forward(w, U, Y + s, stride, (b + PACK - 1) / PACK * PACK);
      if (is_first) {
        for (size j = 0; j < s; j += PACK) {
          size end = s - j < PACK ? s - j : PACK;
          product(w, Y, Y + j, stride, j + end, end, Q + j, s);
        }
        for (size a = 0; a < s; a++)
          for (size c = 0; c < a; c++)
            Q[a * s + c] = Q[c * s + a];
      }
      for (size c = 0; c < cells; c++) {
        size cell = member[m + c];
        for (size a = 0; a < v; a++) {
          double sum = 0.0, *G = gradient + cell * s * v;
          for (size j = 0; j < s; j++)
            G[j * v + a] = 0.0;
          for (size i = 0; i < w; i++) {
            double *row = Y + i * stride, y = row[s + c * v + a];
            sum += y * y;
            for (size j = 0; j < s; j++)
              G[j * v + a] += row[j] * y;
          }
          constant[cell * v + a] = sum;
        }
      }
    }
  }
  return classes;
}

/* -- facets -------------------------------------------------------------------------------- */

/* Number the facets (cells, f) of some cells from zero, in the order of their first cells.

   `seen` has a zero for each facet of the rank, and has again afterwards. `number` (cells, f)
   becomes the numbers, `side` (facets, 2) the places of each facet among these, or -1, and `place`
   (cells, f, t) the order of the facet's nodes (cells, f, t) by their numbers. Returns the number
   of facets. */
size mesh_error_number(size cells, size f, size t, const int32_t *facets, const int32_t *nodes,
                       int32_t *seen, int32_t *number, int32_t *side, int32_t *place)
{
  int32_t count = 0;
  for (int32_t i = 0; i < cells * f; i++) {
    int32_t old = seen[facets[i]];
    if (old)
      number[i] = old - 1, side[2 * (old - 1) + 1] = i;
    else {
      number[i] = count, side[2 * count] = i, side[2 * count + 1] = -1;
      seen[facets[i]] = ++count;
    }
    const int32_t *of_facet = nodes + i * t;
    int32_t *order = place + i * t;
    for (int32_t a = 0; a < t; a++) {
      int32_t b = a;
      for (; b > 0 && of_facet[order[b - 1]] > of_facet[a]; b--)
        order[b] = order[b - 1];
      order[b] = a;
    }
  }
  for (size i = 0; i < cells * f; i++)
    seen[facets[i]] = 0;
  return count;
}

/* The cells with f facets of m = t * d moments each, whose matrices are Q (number[k], f * m, f * m).

   Moments of a facet have the order of the numbers of its nodes; `sign` is that of the sides of
   cells. */
typedef struct {
  size cells, facets, f, t, d, v;
  const int32_t *number, *facet, *place, *side;
  const double *Q, *middle;
  double length;
} Cells;

static double sign_of(const Cells *c, size at) { return c->side[2 * c->facet[at]] == at ? 1.0 : -1.0; }

/* Place of moment i of a facet among those of a cell, from the place of the facet. */
static size row_of(const Cells *c, size at, size i)
{
  return ((at % c->f) * c->t + c->place[at * c->t + i / c->d]) * c->d + i % c->d;
}

/* Sum up values (cells, f * m, v) of cells on facets (facets, m, v). */
void mesh_error_to_facets(const Cells *c, const double *values, double *total)
{
  size t = c->t, w = c->d * c->v;
  memset(total, 0, c->facets * t * w * sizeof *total);
  /* moments of all facets of all cells are one after the other */
  for (size at = 0; at < c->cells * c->f; at++) {
    double sign = sign_of(c, at), *sum = total + c->facet[at] * t * w;
    for (size i = 0; i < t; i++) {
      const double *of_node = values + (at * t + c->place[at * t + i]) * w;
      for (size a = 0; a < w; a++)
        sum[i * w + a] += sign * of_node[a];
    }
  }
}

static void gather(const Cells *c, size cell, const double *p, double *of_cell)
{
  size t = c->t, w = c->d * c->v;
  for (size q = 0; q < c->f; q++) {
    size at = cell * c->f + q;
    double sign = sign_of(c, at);
    const double *of_facet = p + c->facet[at] * t * w;
    for (size i = 0; i < t; i++) {
      double *of_node = of_cell + (q * t + c->place[at * t + i]) * w;
      for (size a = 0; a < w; a++)
        of_node[a] = sign * of_facet[i * w + a];
    }
  }
}

/* Compute Qp (cells, f * m, v) for p (facets, m, v). `work` has room for f * m * v numbers. */
void mesh_error_stiffness(const Cells *c, const double *p, double *Qp, double *work)
{
  size s = c->f * c->t * c->d, v = c->v;
  for (size k = 0; k < c->cells; k++) {
    const double *Q = c->Q + (size)c->number[k] * s * s;
    double *out = Qp + k * s * v;
    gather(c, k, p, work);
    if (v == 1) {
      memset(out, 0, s * sizeof *out);
      for (size i = 0; i < s; i++)
        for (size j = 0; j < s; j++)
          out[j] += work[i] * Q[i * s + j];
    } else
      for (size i = 0; i < s; i++)
        for (size a = 0; a < v; a++) {
          double sum = 0.0;
          for (size j = 0; j < s; j++)
            sum += Q[i * s + j] * work[j * v + a];
          out[i * v + a] = sum;
        }
  }
}

/* Add the change of the energies (cells, v) to these, and of the gradients (cells, f * m, v), of
   steps alpha (v,) along p. */
void mesh_error_advance(const Cells *c, const double *alpha, const double *p, const double *Qp,
                        double *gradient, double *energy, double *work)
{
  size s = c->f * c->t * c->d, v = c->v;
  for (size k = 0; k < c->cells; k++) {
    gather(c, k, p, work);
    double *g = gradient + k * s * v;
    const double *q = Qp + k * s * v;
    for (size i = 0; i < s; i++)
      for (size a = 0; a < v; a++) {
        size at = i * v + a;
        energy[k * v + a] += alpha[a] * work[at] * (2.0 * g[at] + alpha[a] * q[at]);
        g[at] += alpha[a] * q[at];
      }
  }
}

/* -- the preconditioner -------------------------------------------------------------------- */

static size resultants(size d) { return d == 2 ? 3 : 6; }

/* Components of the moment q of a force: that along b times the arm along a, less the converse. */
static void plane(size d, size q, size *a, size *b) { *a = q, *b = (q + 1) % d; }

/* Write the resultants (m, n) about the middle of a facet of unit moments at nodes x (t, d). */
static void resultants_of(const Cells *c, const double *x, const double *middle, double *N)
{
  size d = c->d, n = resultants(d), a, b;
  memset(N, 0, c->t * d * n * sizeof *N);
  for (size i = 0; i < c->t; i++) {
    for (size k = 0; k < d; k++)
      N[(i * d + k) * n + k] = 1.0;
    for (size q = 0; q < n - d; q++) {
      plane(d, q, &a, &b);
      N[(i * d + a) * n + d + q] = -(x[i * d + b] - middle[b]) / c->length;
      N[(i * d + b) * n + d + q] = (x[i * d + a] - middle[a]) / c->length;
    }
  }
}

/* For each facet with nodes x (facets, t, d): tractions W (facets, m, PACK) with unit resultants about
   the middle, and an orthonormal basis Z (facets, m - n, m) of those without. `work` has room for
   (m + 1) * n + m numbers. */
void mesh_error_facets(const Cells *c, const double *x, double *W, double *Z, double *work)
{
  size m = c->t * c->d, n = resultants(c->d);
  double *N = work, *left = work + m * n, G[RESULTANTS * RESULTANTS];
  double spare[RESULTANTS * RESULTANTS];
  for (size f = 0; f < c->facets; f++) {
    double *w = W + f * m * PACK, *basis = Z + f * (m - n) * m;
    resultants_of(c, x + f * m, c->middle + f * c->d, N);
    for (size a = 0; a < n; a++)
      for (size b = 0; b < n; b++) {
        G[a * n + b] = 0.0;
        for (size i = 0; i < m; i++)
          G[a * n + b] += N[i * n + a] * N[i * n + b];
      }
    invert(n, G, 0.0, spare);
    for (size i = 0; i < m; i++) {
      left[i] = 1.0;
      for (size b = 0; b < PACK; b++)
        w[i * PACK + b] = 0.0;
      for (size b = 0; b < n; b++) {
        for (size a = 0; a < n; a++)
          w[i * PACK + b] += N[i * n + a] * G[a * n + b];
        left[i] -= w[i * PACK + b] * N[i * n + b];
      }
    }
    /* projections of the unit vectors that are farthest from the span of those before */
    for (size q = 0; q < m - n; q++) {
      double *z = basis + q * m, square = 0.0;
      size best = 0;
      for (size i = 1; i < m; i++)
        best = left[i] > left[best] ? i : best;
      for (size i = 0; i < m; i++) {
        z[i] = i == best;
        for (size a = 0; a < n; a++)
          z[i] -= w[i * PACK + a] * N[best * n + a];
      }
      for (size k = 0; k < 2 * q; k++) {
        const double *before = basis + k % q * m;
        double dot = 0.0;
        for (size i = 0; i < m; i++)
          dot += before[i] * z[i];
        for (size i = 0; i < m; i++)
          z[i] -= dot * before[i];
      }
      for (size i = 0; i < m; i++)
        square += z[i] * z[i];
      for (size i = 0; i < m; i++) {
        z[i] /= sqrt(square);
        left[i] -= z[i] * z[i];
      }
    }
  }
}

/* Change factors (n, columns) of unit resultants about a point into those about the middle of a
   facet, where `arm` is from the point to the middle, relative to the length. */
INLINE void from(size d, const double *arm, double *factor, size columns)
{
  for (size q = 0; q < resultants(d) - d; q++) {
    size a, b;
    plane(d, q, &a, &b);
    for (size i = 0; i < columns; i++)
      factor[(d + q) * columns + i] -=
          arm[a] * factor[b * columns + i] - arm[b] * factor[a * columns + i];
  }
}

/* How forces pass rings: once around, in some way between supported ends, or not at all. */
enum { CLOSED, OPEN, CUT };

/* Walk around rings of cells. The places (cells, e) of ring r are order[first[r]], ...; in the cell
   of place i the ring passes the facets pair[i % e] (2,). `cell` and `facet` (places, 2) become its
   cells in the order of the walk, and the facets before and after each, `sense` (places,) the
   direction of a force through the facet after, relative to its first cell; `how` (rings,) tells
   how forces pass, `middle` (rings, d) the middle of closed ones. `may_end` (facets,) tells at which
   single facets they may end. */
void mesh_error_walk(const Cells *c, size rings, size e, const int32_t *first, const int32_t *order,
                     const int32_t *pair, const uint8_t *may_end, int32_t *cell, int32_t *facet,
                     double *sense, uint8_t *how, double *middle)
{
  for (size r = 0; r < rings; r++) {
    size begin = first[r], end = first[r + 1], steps = 0, ends = 0;
    how[r] = CUT;
    for (size a = 0; a < c->d; a++)
      middle[r * c->d + a] = 0.0;
    for (size i = begin; i < end; i++) {
      size k = order[i] / e;
      for (int q = 0; q < 2; q++) {
        size f = c->facet[k * c->f + pair[(order[i] % e) * 2 + q]];
        facet[2 * i + q] = (int32_t)f;
        if (c->side[2 * f + 1] < 0)
          ends += 1 + ((size)may_end[f] << 32);
      }
      cell[i] = (int32_t)k;
    }
    if (ends >> 32)
      how[r] = OPEN;
    if (ends || end == begin)
      continue;
    /* facets are between two cells: the next one is that with the facet after */
    for (size i = begin; i + 1 < end; i++) {
      size j = i + 1;
      while (j < end && facet[2 * j] != facet[2 * i + 1] && facet[2 * j + 1] != facet[2 * i + 1])
        j++;
      if (j == end)
        break;
      int32_t k = cell[j], f = facet[2 * j], g = facet[2 * j + 1];
      cell[j] = cell[i + 1], facet[2 * j] = facet[2 * i + 2], facet[2 * j + 1] = facet[2 * i + 3];
      cell[i + 1] = k;
      facet[2 * i + 2] = facet[2 * i + 1], facet[2 * i + 3] = f == facet[2 * i + 1] ? g : f;
      steps++;
    }
    if (steps != end - begin - 1 || facet[2 * end - 1] != facet[2 * begin])
      continue;
    for (size i = begin; i < end; i++)
      for (size a = 0; a < c->d; a++)
        middle[r * c->d + a] += c->middle[facet[2 * i + 1] * c->d + a] / (end - begin);
    for (size i = begin; i < end; i++)
      sense[i] = c->side[2 * facet[2 * i + 1]] / c->f == cell[i] ? 1.0 : -1.0;
    how[r] = CLOSED;
  }
}

/* Compute H (n, n) += X'Y of tractions with unit resultants on facets, X and Y (m, PACK). */
INLINE void add_product(size m, size n, const double *X, const double *Y, double factor, double *H)
{
  pack sum[RESULTANTS] = {{0}};
  for (size i = 0; i < m; i++)
    for (size a = 0; a < RESULTANTS; a++)
      sum[a] += X[i * PACK + a] * CONST_AT(Y + i * PACK);
  for (size a = 0; a < n; a++)
    for (size b = 0; b < n; b++)
      H[a * n + b] += factor * sum[a][b];
}

/* Invert the energies of changes: of those without resultants Z on facets, z = m - n, `of_facets`
   (facets, z, z), which are zero where moments may not change; of unit resultants, about the middle
   of each ring, that pass around closed ones, `of_rings` (rings, n, n), others are zero.

   The e entities of each cell are the rings `entity` (cells, e), between the facets pair (e, 2).
   `work` has room for (4 * f * m + 2) * PACK + z * m + m * m numbers. */
void mesh_error_inverses(const Cells *c, size rings, size e, const int32_t *entity,
                         const int32_t *pair, const uint8_t *how, const uint8_t *may_change,
                         const double *ring_middle, const double *W, const double *Z, double shift,
                         double *of_facets, double *of_rings, double *work)
{
  size d = c->d, n = resultants(d), m = c->t * d, f = c->f, s = f * m, z = m - n;
  double *X = work, *QX = X + s * PACK, *zeta = QX + f * s * PACK, *spare = zeta + z * m;
  memset(of_facets, 0, c->facets * z * z * sizeof *of_facets);
  memset(of_rings, 0, rings * n * n * sizeof *of_rings);
  for (size k = 0; k < c->cells; k++) {
    const double *Q = c->Q + (size)c->number[k] * s * s;
    const double *origin = c->middle + c->facet[k * f] * d;
    for (size p = 0; p < f; p++) {
      size at = k * f + p, facet = c->facet[at];
      /* unit resultants about a point of the cell, and changes, in the order of the cell */
      double S[RESULTANTS * PACK] = {0}, arm[3], *E = of_facets + facet * z * z;
      for (size a = 0; a < n; a++)
        S[a * PACK + a] = 1.0;
      for (size a = 0; a < d; a++)
        arm[a] = (c->middle[facet * d + a] - origin[a]) / c->length;
      from(d, arm, S, PACK);
      for (size i = 0; i < m; i++) {
        size row = row_of(c, at, i);
        pack sum = {0};
        for (size a = 0; a < n; a++)
          sum += W[(facet * m + i) * PACK + a] * AT(S + a * PACK);
        AT(X + row * PACK) = sum;
        for (size q = 0; q < z; q++)
          zeta[q * m + row - p * m] = Z[(facet * z + q) * m + i];
      }
      for (size i = 0; i < s; i += ROWS) {
        pack sum[ROWS] = {{0}};
        for (size j = p * m; j < (p + 1) * m; j++)
          for (size a = 0; a < ROWS; a++)
            sum[a] += Q[(i + a < s ? i + a : i) * s + j] * CONST_AT(X + j * PACK);
        for (size a = 0; a < ROWS && i + a < s; a++)
          AT(QX + (p * s + i + a) * PACK) = sum[a];
      }
      for (size q = 0; q < z && may_change[facet]; q++) {
        memset(spare, 0, m * sizeof *spare);
        for (size i = 0; i < m; i++)
          for (size j = 0; j < m; j++)
            spare[j] += zeta[q * m + i] * Q[(p * m + i) * s + p * m + j];
        for (size r = 0; r < z; r++)
          for (size j = 0; j < m; j++)
            E[q * z + r] += spare[j] * zeta[r * m + j];
      }
    }
    for (size i = 0; i < e; i++) {
      size r = entity[k * e + i], p = pair[2 * i], q = pair[2 * i + 1];
      if (how[r] != CLOSED)
        continue;
      double H[RESULTANTS * RESULTANTS] = {0}, *E = of_rings + r * n * n, arm[3];
      add_product(m, n, X + p * m * PACK, QX + (p * s + p * m) * PACK, 1.0, H);
      add_product(m, n, X + q * m * PACK, QX + (q * s + q * m) * PACK, 1.0, H);
      add_product(m, n, X + p * m * PACK, QX + (q * s + p * m) * PACK, -1.0, H);
      add_product(m, n, X + q * m * PACK, QX + (p * s + q * m) * PACK, -1.0, H);
      /* S'HS for the factors S about the middle of the ring */
      for (size a = 0; a < d; a++)
        arm[a] = (origin[a] - ring_middle[r * d + a]) / c->length;
      for (int side = 0; side < 2; side++)
        for (size t = 0; t < n - d; t++) {
          size a, b, one = side ? 1 : n, other = side ? n : 1;
          plane(d, t, &a, &b);
          for (size j = 0; j < n; j++) {
            double moment = H[(d + t) * one + j * other];
            H[b * one + j * other] -= arm[a] * moment;
            H[a * one + j * other] += arm[b] * moment;
          }
        }
      for (size a = 0; a < n * n; a++)
        E[a] += H[a];
    }
  }
  for (size p = 0; p < c->facets; p++)
    if (may_change[p])
      invert(z, of_facets + p * z * z, shift, spare);
  for (size r = 0; r < rings; r++)
    if (how[r] == CLOSED)
      invert(n, of_rings + r * n * n, shift, spare);
}

/* Precondition residuals (facets, m, v) with facets and closed rings. `sums` has room for
   2 * facets * n + m numbers. */
void mesh_error_precondition(const Cells *c, size rings, const int32_t *first, const int32_t *facet,
                             const double *sense, const uint8_t *how, const double *middle,
                             const double *W, const double *Z, const double *of_facets,
                             const double *of_rings, const double *residual, double *result,
                             double *sums)
{
  size d = c->d, n = resultants(d), m = c->t * d, v = c->v, z = m - n;
  double *resultant = sums, *change = sums + c->facets * n, *part = change + c->facets * n;
  for (size a = 0; a < v; a++) {
    memset(change, 0, c->facets * n * sizeof *change);
    for (size f = 0; f < c->facets; f++) {
      pack sum = {0};
      for (size i = 0; i < m; i++)
        sum += residual[(f * m + i) * v + a] * CONST_AT(W + (f * m + i) * PACK);
      for (size k = 0; k < n; k++)
        resultant[f * n + k] = sum[k];
    }
    for (size r = 0; r < rings; r++) {
      if (how[r] != CLOSED)
        continue;
      double total[RESULTANTS] = {0}, y[RESULTANTS] = {0};
      const double *x = middle + r * d, *E = of_rings + r * n * n;
      for (int is_back = 0; is_back < 2; is_back++) {
        for (size i = first[r]; i < first[r + 1]; i++) {
          size f = facet[2 * i + 1], p, q;
          double arm[3], passed[RESULTANTS];
          for (size k = 0; k < d; k++)
            arm[k] = (c->middle[f * d + k] - x[k]) / c->length;
          if (is_back) {
            memcpy(passed, y, n * sizeof *passed);
            from(d, arm, passed, 1);
            for (size k = 0; k < n; k++)
              change[f * n + k] += sense[i] * passed[k];
          } else {
            /* the transpose */
            memcpy(passed, resultant + f * n, n * sizeof *passed);
            for (size k = 0; k < n - d; k++) {
              plane(d, k, &p, &q);
              passed[q] -= arm[p] * passed[d + k];
              passed[p] += arm[q] * passed[d + k];
            }
            for (size k = 0; k < n; k++)
              total[k] += sense[i] * passed[k];
          }
        }
        for (size k = 0; k < n && !is_back; k++)
          for (size l = 0; l < n; l++)
            y[k] += E[k * n + l] * total[l];
      }
    }
    for (size f = 0; f < c->facets; f++) {
      const double *basis = Z + f * z * m, *E = of_facets + f * z * z;
      for (size q = 0; q < z; q++) {
        part[q] = 0.0;
        for (size i = 0; i < m; i++)
          part[q] += basis[q * m + i] * residual[(f * m + i) * v + a];
      }
      for (size i = 0; i < m; i++) {
        double sum = 0.0;
        for (size k = 0; k < n; k++)
          sum += W[(f * m + i) * PACK + k] * change[f * n + k];
        result[(f * m + i) * v + a] = sum;
      }
      for (size q = 0; q < z; q++) {
        double y = 0.0;
        for (size r = 0; r < z; r++)
          y += E[q * z + r] * part[r];
        for (size i = 0; i < m; i++)
          result[(f * m + i) * v + a] += y * basis[q * m + i];
      }
    }
  }
}
