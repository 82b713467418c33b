// SPDX-License-Identifier: BSD-3-Clause
#include "code/code_book.hpp"

#include <algorithm>

namespace roundel {

namespace {

constexpr int kArcs = 3;
constexpr Word kWords = Word(1) << kCodeSectors;

Word mirrored(Word word) {
    Word image = 0;
    for (int k = 0; k < kCodeSectors; ++k) image |= ((word >> k) & 1) << (kCodeSectors - 1 - k);
    return image;
}

bool is_first_turn(Word word) {
    for (Word view = turned(word, 1); view != word; view = turned(view, 1))
        if (view < word) return false;
    return true;
}

/// Whether a test is true for a turn of the word, from the `first` on, or for one of its mirror image.
template <typename Test>
bool any_view(Word word, int first, const Test& test) {
    Word view = word, image = mirrored(word);
    for (int s = 0; s < kCodeSectors; ++s) {
        if ((s >= first && test(view)) || test(image)) return true;
        view = turned(view, 1);
        image = turned(image, 1);
    }
    return false;
}

/// Each word marks those that are too similar, which is faster than a comparison of all with all.
std::vector<Word> make_words() {
    std::vector<int8_t> black(kWords);  // sectors of a word: a table is faster than std::popcount on x86-64
    std::vector<Word> small, words;     // `small` differences are those of words that are too similar
    for (Word word = 1; word < kWords; ++word) black[word] = int8_t(black[word / 2] + word % 2);
    for (Word word = 0; word < kWords; ++word)
        if (black[word] < kCodeDistance) small.push_back(word);
    std::vector<bool> is_similar(kWords);
    for (Word word = 0; word < kWords; ++word) {
        const int arcs = black[word ^ turned(word, 1)] / 2;
        if (std::min(+black[word], kCodeSectors - black[word]) < kCodeDistance || arcs < kArcs) continue;
        const auto is_near = [&](Word view) { return black[word ^ view] < kCodeDistance; };
        if (!is_first_turn(word) || any_view(word, 1, is_near)) continue;
        if (any_view(word, 0, [&](Word view) { return is_similar[view]; })) continue;
        words.push_back(word);
        for (const Word difference : small) is_similar[word ^ difference] = true;
    }
    return words;
}

}  // namespace

const std::vector<Word>& code_words() {
    static const std::vector<Word> words = make_words();
    return words;
}

}  // namespace roundel
