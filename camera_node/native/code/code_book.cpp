// SPDX-License-Identifier: BSD-3-Clause
#include "code/code_book.hpp"

#include <algorithm>
#include <cstdlib>

namespace roundel {

namespace {

constexpr int kArcs = 3;

int distance(Word a, Word b) { return std::popcount(a ^ b); }

Word mirrored(Word word) {
    Word image = 0;
    for (int k = 0; k < kCodeSectors; ++k) image |= ((word >> k) & 1) << (kCodeSectors - 1 - k);
    return image;
}

/// Whether the word differs enough from all turns of another one.
bool differs(Word word, Word other) {
    if (std::abs(std::popcount(word) - std::popcount(other)) >= kCodeDistance) return true;
    for (int s = 0; s < kCodeSectors; ++s)
        if (distance(word, turned(other, s)) < kCodeDistance) return false;
    return true;
}

bool is_possible(Word word) {
    const int black = std::popcount(word), arcs = distance(word, turned(word, 1)) / 2;
    if (std::min(black, kCodeSectors - black) < kCodeDistance || arcs < kArcs) return false;
    for (int s = 1; s < kCodeSectors; ++s)
        if (turned(word, s) < word || distance(word, turned(word, s)) < kCodeDistance) return false;
    return differs(word, mirrored(word));
}

std::vector<Word> make_words() {
    std::vector<Word> words;
    for (Word word = 0; word < Word(1) << kCodeSectors; ++word) {
        if (!is_possible(word)) continue;
        const Word image = mirrored(word);
        if (std::all_of(words.begin(), words.end(),
                        [=](Word w) { return differs(w, word) && differs(w, image); }))
            words.push_back(word);
    }
    return words;
}

}  // namespace

const std::vector<Word>& code_words() {
    static const std::vector<Word> words = make_words();
    return words;
}

}  // namespace roundel
